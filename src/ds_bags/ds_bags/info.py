# SPDX-License-Identifier: Apache-2.0
"""Describes a bag as JSON values and as lines of text."""

from __future__ import annotations

import math
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from ds_bags.layout import printable
from ds_bags.reader import BagReader


def describe(path: Path) -> dict[str, Any]:
    """Describe a bag as JSON values: its size, topics, and custom data.

    Decompresses nothing if the file has an index, and imports nothing that the bag names.

    Raises:
        ds_bags.layout.BagError: the bag cannot be read.

    Examples:
        >>> from pathlib import Path
        >>> from ds_bags import describe, write_bag
        >>> from ds_road import Road
        >>> from ds_sim import Scenario, Session, make_simulator
        >>> session = Session(make_simulator("softbody"))
        >>> frame = session.start(Scenario(Road([(125, 0), (125, 25), (125, 50), (125, 75)]), seed=1))
        >>> images = write_bag(Path("first_frame"), "/ds2", "softbody", session.run, about={})
        >>> describe(Path("first_frame"))["facts"]["simulator"]
        'softbody'
    """
    with BagReader(path) as bag:
        files = [*bag.files, *([bag.path / "metadata.yaml"] if bag.path.is_dir() else [])]
        return {
            "bag": str(bag.path),
            "files": len(files),
            "bytes": sum(file.stat().st_size for file in files),
            "seconds": bag.seconds,
            "messages": sum(connection.msgcount for connection in bag.connections),
            "topics": [{"name": c.topic, "type": c.msgtype, "messages": c.msgcount} for c in bag.connections],
            "facts": bag.facts,
        }


def info_in_words(document: Mapping[str, Any]) -> list[str]:
    """Turn the result of `describe` into lines of text: the outcome of the run first, then what is recorded."""
    facts = {printable(key): printable(value) for key, value in document["facts"].items()}
    size = f"{document['bytes'] / 1e6:.2f} MB in {document['files']} files"
    lines = [f"{document['bag']}: {document['messages']} messages over {document['seconds']:.2f} s, {size}."]
    if "simulator" in facts:
        lines += _run_in_words(facts)
    elif facts:
        lines += [f"{key}: {value}" for key, value in sorted(facts.items())]
    else:
        lines.append("No custom data: road, driver and outcome are unknown.")
    return lines


def _run_in_words(facts: Mapping[str, str]) -> list[str]:
    outcome = facts.get("outcome", "unknown").replace("_", " ").lower()
    reason = f" ({facts['message']})" if facts.get("message") else ""
    frames = f" after {facts['steps']} frames" if "steps" in facts else ""
    lines = [f"{facts.get('driver') or 'An unnamed driver'} drove on {facts['simulator']}: {outcome}{frames}{reason}."]
    margin, offset = _number(facts, "fitness"), _number(facts, "max_lateral_position")
    if margin is not None and offset is not None:
        edge = f"{margin:.2f} m inside its lane" if margin >= 0.0 else f"{-margin:.2f} m out of its lane"
        lines.append(f"At worst the vehicle was {offset:.2f} m off the lane's centre, {edge}.")
    lines.append(f"Road {facts.get('road_id', '?')}, seed {facts.get('seed', '?')}, level {facts.get('level', '?')}.")
    if facts.get("conditions"):
        lines.append(f"Conditions {facts['conditions']}.")
    images, steps = _number(facts, "images"), _number(facts, "steps")
    if images is not None and steps is not None and images <= steps:
        lines.append(f"Only {images:.0f} of {steps + 1:.0f} images arrived.")
    if facts.get("test_id"):
        lines.append(f"Test {facts['test_id']} of a campaign.")
    versions = [f"{key.removeprefix('version.')} {facts[key]}" for key in sorted(facts) if key.startswith("version.")]
    lines.append(f"Recorded with {', '.join([facts.get('engine', ''), *versions]).strip(', ')}.")
    return lines


def _number(facts: Mapping[str, str], key: str) -> float | None:
    """Return a fact as a finite number, or None."""
    try:
        value = float(facts[key])
    except (KeyError, ValueError):
        return None
    return value if math.isfinite(value) else None
