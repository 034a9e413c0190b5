# SPDX-License-Identifier: Apache-2.0
"""`ds bag replay`: publishes a bag to the graph, controlled by single keys."""

from __future__ import annotations

import contextlib
import fnmatch
import math
import os
import select
import sys
import termios
import time
import tty
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import asdict
from pathlib import Path

import typer

from ds_bags.player import PAUSE, QUIT, STEP
from ds_base.installation import ds_command
from ds_cli.output import Interrupted, Result, say

KEYS = {" ": PAUSE, "s": STEP, "\x1b[C": STEP, "q": QUIT}
"""Character sequence of a key -> control; the third is the right arrow."""


@contextmanager
def player_keys() -> Iterator[Callable[[float], str]]:
    """Yield a function that waits some seconds for a key and returns its control; without a terminal it only waits."""
    if not sys.stdin.isatty():
        yield _sleep
        return
    file = sys.stdin.fileno()
    before = termios.tcgetattr(file)

    def wait(seconds: float) -> str:
        if not select.select([file], [], [], seconds)[0]:
            return ""
        return KEYS.get(os.read(file, 16).decode(errors="replace").lower().replace("\x1b[c", "\x1b[C"), "")

    try:
        tty.setcbreak(file)  # Ctrl-C still interrupts
        yield wait
    finally:
        termios.tcsetattr(file, termios.TCSADRAIN, before)


def _sleep(seconds: float) -> str:
    time.sleep(seconds)
    return ""


def bag_replay(folder: Path, rate: float, topics: list[str], wait: float) -> Result:
    """Publish a bag to the graph."""
    from ds_bags.layout import BagError
    from ds_bags.player import Controls, play
    from ds_bags.reader import BagReader
    from ds_bags.ros.publisher import GraphOutput

    with BagReader(folder) as bag:
        if folder.suffix == ".bag":
            raise BagError(f"{folder} is a bag of ROS 1: convert it with `rosbags-convert` first")
        # The player publishes /clock itself.
        chosen = [c for c in bag.connections if c.topic != "/clock" and _is_wanted(c.topic, topics)]
        if not chosen:
            names = ", ".join(sorted(connection.topic for connection in bag.connections))
            raise BagError(f"{folder} has no topic {' or '.join(topics)}: it has {names}")
        try:
            with player_keys() as keys, GraphOutput(chosen, patient=math.isinf(rate)) as output:
                for topic, reason in output.skipped.items():
                    say(f"{topic} is left out: {reason}")
                if sys.stdin.isatty():
                    say("space pauses and resumes, s or the right arrow steps, q quits")
                say(f"waiting up to {wait:g} s for a subscriber")
                if not output.wait_for_readers(wait) and wait:
                    say(f"no subscriber after {wait:g} s: playing anyway")
                controls = Controls(now=time.monotonic, wait=keys, report=say)
                wanted = [c for c in chosen if c.topic not in output.skipped]
                played = play(bag.messages(wanted), output, rate=rate, controls=controls)
                skipped = dict(output.skipped)
        except KeyboardInterrupt:
            raise Interrupted from None
    document = asdict(played) | {"skipped": skipped}

    def show() -> None:
        print(f"{played.messages} messages of {played.seconds:.2f} s")

    return Result(document=document, show=show, next=ds_command("bag", "info", folder))


def _is_wanted(topic: str, patterns: list[str]) -> bool:
    return not patterns or any(fnmatch.fnmatchcase(topic, pattern) for pattern in patterns)


def rate_of(text: str) -> float:
    """Parse a speed as a factor; infinity for `max`."""
    with contextlib.suppress(ValueError):
        value = math.inf if text == "max" else float(text)
        if value > 0.0:
            return value
    raise typer.BadParameter(f"{text!r}: expected a number above 0, or max")
