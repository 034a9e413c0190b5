"""Draws and measures the camera of `panda` for docs/cameras.md.

`python -m benchmarks.panda_camera [--out docs/images]` writes `panda_views.png`, and prints what loading a road and an
image take in processor time, beside the camera of `bullet` in the same seconds, and how much the far rows of an image
flicker on a straight drive.
"""

from __future__ import annotations

import argparse
import math
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any
from unittest import mock

import cv2
import numpy as np
from benchmarks.camera import poses
from numpy.typing import NDArray

from ds_road import Road, generate
from ds_sim.camera.ground import paint_ground
from ds_sim.camera.renderer import Camera
from ds_sim.registry import spec_of
from ds_sim.simulator import VehicleState
from ds_sim_panda.scene import textures, world
from ds_sim_panda.scene.panda_scene import PandaScene

STRAIGHT = Road([(125.0, 25.0 * i) for i in range(9)])
RNG = np.random.default_rng(0)
ROUNDS = 10


def loaded(road: Road, spec: Any) -> PandaScene:
    """Scene of a road, ready to draw."""
    scene = PandaScene(spec)
    scene.load(road, RNG)
    return scene


def views() -> NDArray[np.uint8]:
    """Twelve images: a straight road, and bends of three random ones; the last of each row has a roll of 0.08 rad."""
    spec, rows = spec_of("panda").camera, []
    for road in (STRAIGHT, *(generate(np.random.default_rng(seed), max_angle=270) for seed in (21, 23))):
        scene, lane = loaded(road, spec), road.right_lane_centre
        images = []
        for share, roll in ((0.03, 0.0), (0.3, 0.0), (0.55, 0.0), (0.75, 0.08)):
            index = int(share * len(lane))
            ahead = lane[index + 1] - lane[index]
            state = VehicleState(
                x=lane[index, 0], y=lane[index, 1], yaw=math.atan2(ahead[1], ahead[0]), roll=roll,
                speed=0.0, yaw_rate=0.0, steering_angle=0.0,
            )  # fmt: skip
            images.append(scene.image(state))
        rows.append(np.hstack(images))
    return np.vstack(rows)


def cpu_ms(call: Callable[[VehicleState], object], states: list[VehicleState]) -> float:
    """Processor time of a call, mean over some states, ms."""
    started = time.process_time()
    for state in states:
        call(state)
    return 1e3 * (time.process_time() - started) / len(states)


def speed() -> None:
    """Print processor times by turns with the camera of bullet, medians of `ROUNDS`."""
    road, states, bullet = generate(np.random.default_rng(4), max_angle=60), poses(4), spec_of("bullet")
    scene, ground = loaded(road, spec_of("panda").camera), paint_ground(road, bullet.look)
    part = loaded(road, spec_of("panda").camera)
    part.draw_rows(spec_of("panda").crop_top, 160)
    part.load(road, RNG)
    large = loaded(road, replace(spec_of("panda").camera, width=640, height_px=480))
    camera = Camera(bullet.camera, bullet.look)
    calls: dict[str, Callable[[VehicleState], object]] = {
        "bullet, 320 x 160": lambda state: camera.render(ground, state),
        "panda, 320 x 160": scene.image,
        "panda, rows that a network sees": part.image,
        "panda, 640 x 480": large.image,
    }
    times: dict[str, list[float]] = {name: [] for name in (*calls, "panda, load with its first image")}
    for _ in range(ROUNDS):
        for name, call in calls.items():
            call(states[0])
            times[name].append(cpu_ms(call, states[::3]))
        started = time.process_time()
        part.load(road, RNG)
        part.image(states[0])
        times["panda, load with its first image"].append(1e3 * (time.process_time() - started))
    for name, values in times.items():
        print(f"{name:<34} {np.median(values):6.2f} ms (least {min(values):.2f})")


def flicker(*, textured: bool, furnished: bool) -> float:
    """Standard deviation over time of the least steady pixel of each far row, mean over rows, grey levels.

    Args:
        textured: whether surfaces have their textures.
        furnished: whether something stands beside the road.
    """
    plain = mock.patch.object(textures, "noise", lambda size, *args, **kwargs: np.zeros(size))
    empty = mock.patch.object(world, "place_scenery", return_value={})
    for name in ("grass", "gravel", "asphalt", "patches"):
        getattr(textures, name).cache_clear()
    with plain if not textured else mock.MagicMock(), empty if not furnished else mock.MagicMock():
        scene = loaded(STRAIGHT, spec_of("panda").camera)
        states = [
            VehicleState(x=127.0, y=30.0 + 0.137 * i, yaw=math.pi / 2, speed=0.0, yaw_rate=0.0, steering_angle=0.0)
            for i in range(24)
        ]
        frames = [scene.image(state)[61:75].astype(float) for state in states]
    return float(np.std(frames, axis=0)[:, 110:210].max(axis=1).mean())


def main() -> None:
    """Write the picture, print the measurements."""
    parser = argparse.ArgumentParser(description=__doc__.split("\n\n")[0])  # type: ignore[union-attr]
    parser.add_argument("--out", type=Path, default=Path("docs/images"))
    out = parser.parse_args().out
    cv2.setNumThreads(1)
    cv2.imwrite(str(out / "panda_views.png"), cv2.cvtColor(views(), cv2.COLOR_RGB2BGR))
    speed()
    for textured, furnished in ((False, False), (True, False), (True, True)):
        print(
            f"flicker, textures {textured}, scenery {furnished}: {flicker(textured=textured, furnished=furnished):.2f}"
        )


if __name__ == "__main__":
    main()
