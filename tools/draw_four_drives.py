#!/usr/bin/env python3
# SPDX-License-Identifier: Apache-2.0
"""Draw docs/images/four_drives.webp: `dave2` drives one road on four simulators, in clear air and in fog.

Usage: . .venv/env.sh && python tools/draw_four_drives.py [FOLDER]      default: build/four_drives

Makes eight drives with `ds drive --video` (some minutes). Videos that FOLDER holds already are not made again.
"""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path
from typing import Any

import cv2
import numpy as np

ROOT = Path(__file__).resolve().parents[1]
PICTURE = ROOT / "docs/images/four_drives.webp"
SIMULATORS = {"bullet": "sibling", "softbody": "sibling", "panda": "sibling", "donkey": "digital twin"}
ROWS = {"clear air": [], "fog, 40 m of visibility": ["--conditions", "visibility=40"]}
SEED, MAX_ANGLE = 3, 200
SPEED_UP, FRAMES_PER_SECOND, VIDEO_RATE, LAST_PICTURE_MS = 2, 8, 20, 3000
WIDTH, CAMERA_HEIGHT, MAP, GAP, STRIP = 216, 108, 132, 6, 22
HEIGHT = CAMERA_HEIGHT + MAP
CAMERA, ROAD = (slice(0, 480), slice(0, 960)), (slice(28, 308), slice(970, 1250))
"""Where a video of `ds drive` shows the camera and the road, rows and columns in pixels."""
PAPER, INK, PASSED, FAILED = (255, 255, 255), (58, 45, 31), (178, 114, 0), (0, 78, 194)
"""Colours, BGR; of a failure as in the report."""


def drive(folder: Path, simulator: str, row: int, conditions: list[str]) -> tuple[list[Any], bool]:
    """Return pictures of a drive, one for each frame of the result, and whether it was completed."""
    video = folder / f"{simulator}-{row}.mp4"
    answer = video.with_suffix(".json")
    if not answer.is_file():
        road = ["--seed", str(SEED), "--max-angle", str(MAX_ANGLE), *conditions]
        options = ["--sim", simulator, "--driver", "dave2", *road, "--video", str(video), "--json"]
        command = [str(ROOT / "ds"), "drive", *options]
        answer.write_bytes(subprocess.run(command, check=True, stdout=subprocess.PIPE, timeout=900).stdout)
    source, pictures = cv2.VideoCapture(str(video)), []
    while (read := source.read())[0]:
        pictures.append(read[1])
    step = VIDEO_RATE * SPEED_UP / FRAMES_PER_SECOND
    chosen = [pictures[int(index * step)] for index in range(int(len(pictures) / step))]
    completed = json.loads(answer.read_text())["outcome"] == "COMPLETED"
    return [panel(picture) for picture in [*chosen, pictures[-1]]], completed


def panel(picture: Any) -> Any:
    """Scale the camera's picture and put the road from above below it."""
    page = np.full((HEIGHT, WIDTH, 3), PAPER, np.uint8)
    page[:CAMERA_HEIGHT] = cv2.resize(picture[CAMERA], (WIDTH, CAMERA_HEIGHT), interpolation=cv2.INTER_AREA)
    left = (WIDTH - MAP) // 2
    page[CAMERA_HEIGHT:, left : left + MAP] = cv2.resize(picture[ROAD], (MAP, MAP), interpolation=cv2.INTER_AREA)
    return page


def write(page: Any, words: str, x: int, y: int, colour: tuple[int, int, int] = INK) -> None:
    """Write one line."""
    cv2.putText(page, words, (x, y), cv2.FONT_HERSHEY_SIMPLEX, 0.45, colour, 1, cv2.LINE_AA)


def main() -> None:
    """Write the picture."""
    folder = Path(sys.argv[1]) if len(sys.argv) > 1 else ROOT / "build/four_drives"
    folder.mkdir(parents=True, exist_ok=True)
    drives = {
        (name, row): drive(folder, name, row, conditions)
        for row, conditions in enumerate(ROWS.values())
        for name in SIMULATORS
    }
    animation = cv2.Animation()
    for moment in range(max(len(pictures) for pictures, _ in drives.values())):
        page = np.full((STRIP + 2 * (HEIGHT + 2 * STRIP), 4 * WIDTH + 5 * GAP, 3), PAPER, np.uint8)
        for row, title in enumerate(ROWS):
            top = STRIP + row * (HEIGHT + 2 * STRIP)
            write(page, title, GAP, top + 15)
            for column, (name, role) in enumerate(SIMULATORS.items()):
                left, (pictures, completed) = GAP + column * (WIDTH + GAP), drives[name, row]
                if not row:
                    write(page, f"{name}, {role}", left, 15)
                ended = moment >= len(pictures) - 1
                page[top + STRIP : top + STRIP + HEIGHT, left : left + WIDTH] = pictures[min(moment, len(pictures) - 1)]
                if ended:
                    colour = PASSED if completed else FAILED
                    corner = (left + WIDTH - 1, top + STRIP + HEIGHT - 1)
                    cv2.rectangle(page, (left, top + STRIP), corner, colour, 3)
                    write(page, "completed" if completed else "left its lane", left, top + STRIP + HEIGHT + 15, colour)
        animation.frames = [*animation.frames, page]
    animation.durations = [1000 // FRAMES_PER_SECOND] * (len(animation.frames) - 1) + [LAST_PICTURE_MS]
    cv2.imwriteanimation(str(PICTURE), animation, [cv2.IMWRITE_WEBP_QUALITY, 70])
    print(PICTURE)


if __name__ == "__main__":
    main()
