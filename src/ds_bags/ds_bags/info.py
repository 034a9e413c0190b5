"""What is in a bag, for programs and in words."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from ds_bags.reader import BagReader


def describe(path: Path) -> dict[str, Any]:
    """What is in a bag, as JSON values.

    Raises:
        ds_bags.layout.BagError: it cannot be read.
    """
    with BagReader(path) as bag:
        files = [file for file in bag.path.rglob("*") if file.is_file()] if bag.path.is_dir() else [bag.path]
        return {
            "bag": str(bag.path),
            "files": len(files),
            "bytes": sum(file.stat().st_size for file in files),
            "seconds": bag.seconds,
            "messages": sum(connection.msgcount for connection in bag.connections),
            "topics": [{"name": c.topic, "type": c.msgtype, "messages": c.msgcount} for c in bag.connections],
            "facts": bag.facts,
        }


def in_words(document: Mapping[str, Any]) -> list[str]:
    """Lines for a person: what happened first, then what is recorded."""
    facts: Mapping[str, str] = document["facts"]
    size = f"{document['bytes'] / 1e6:.2f} MB in {document['files']} files"
    lines = [f"{document['bag']}: {document['messages']} messages over {document['seconds']:.2f} s, {size}."]
    if "simulator" in facts:
        outcome = facts.get("outcome", "unknown").replace("_", " ").lower()
        why = f" ({facts['message']})" if facts.get("message") else ""
        frames = f" after {facts['steps']} frames" if "steps" in facts else ""
        lines.append(f"{facts.get('driver') or 'Somebody'} drove on {facts['simulator']}: {outcome}{frames}{why}.")
        if "fitness" in facts:
            inside, side = float(facts["fitness"]), float(facts["max_lateral_position"])
            edge = f"{inside:.2f} m inside its lane" if inside >= 0.0 else f"{-inside:.2f} m out of its lane"
            lines.append(f"At its worst the vehicle was {side:.2f} m off the lane's middle, {edge}.")
        lines.append(
            f"Road {facts.get('road_id', '?')}, seed {facts.get('seed', '?')}, level {facts.get('level', '?')}."
        )
        if facts.get("images") and facts.get("steps") and int(facts["images"]) <= int(facts["steps"]):
            lines.append(f"Only {facts['images']} of {int(facts['steps']) + 1} images arrived.")
        if facts.get("test_id"):
            lines.append(f"Test {facts['test_id']} of a campaign.")
        known = [f"{key.removeprefix('version.')} {facts[key]}" for key in sorted(facts) if key.startswith("version.")]
        lines.append(f"Recorded with {', '.join([facts.get('engine', ''), *known]).strip(', ')}.")
    elif facts:
        lines += [f"{key}: {value}" for key, value in sorted(facts.items())]
    else:
        lines.append("Not one of ours: it says nothing about road, driver or outcome.")
    return lines
