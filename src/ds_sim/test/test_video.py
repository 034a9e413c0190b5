# SPDX-License-Identifier: Apache-2.0
"""A drive again and as a video, read by another library's reader."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

from ds_base.palette import PASS, SERIES, rgb
from ds_road import Road
from ds_sim.registry import DONKEY, make_simulator
from ds_sim.scenario import Scenario
from ds_sim.session import RunRecord, Session, resimulate
from ds_sim.simulator import Command
from ds_sim.video import VideoError, check_path, write_video

ROAD = Road([(125.0, 25.0 * i) for i in range(9)])


@pytest.fixture(scope="module")
def run() -> RunRecord:
    """Forty frames on a straight road, ever more to the right."""
    session = Session(make_simulator("donkey"))
    session.start(Scenario(ROAD, seed=3))
    for step in range(40):
        session.advance(Command(0.004 * step, 0.8))
    session.simulator.close()
    assert session.run is not None
    return session.run


def test_a_video_has_every_frame_and_shows_the_drive(tmp_path: Path, run: RunRecord) -> None:
    write_video(tmp_path / "run.mp4", "donkey", ROAD, resimulate(DONKEY, run), run.commands)
    assert [p.name for p in tmp_path.iterdir()] == ["run.mp4"]
    video = cv2.VideoCapture(str(tmp_path / "run.mp4"))
    assert video.get(cv2.CAP_PROP_FPS) == 20.0
    frames = []
    while (got := video.read())[0]:
        frames.append(got[1][..., ::-1].astype(float))
    assert len(frames) == 41 + 20 and frames[0].shape == (480, 1260, 3)
    # The camera's last image, as the simulator gave it.
    image = [o.image for o in resimulate(DONKEY, run)][-1]
    shown = cv2.resize(frames[40][:, :960], (320, 160), interpolation=cv2.INTER_AREA)
    assert np.abs(shown - image).mean() < 6.0
    # The trail on the map, grows.
    trail = [int(((f[28:308, 970:1250] - rgb(SERIES[2])) ** 2).sum(axis=2).__lt__(60**2).sum()) for f in frames]
    assert trail[40] > trail[5] + 10


@pytest.mark.parametrize(("lane_width", "full"), [(3.0, True), (4.0, False)])
def test_the_gauge_of_the_lateral_position_ends_at_the_edge_of_the_lane(
    tmp_path: Path, run: RunRecord, lane_width: float, full: bool
) -> None:
    seen = next(resimulate(DONKEY, run))
    seen = replace(seen, lane=replace(seen.lane, lateral_position=1.5))
    write_video(tmp_path / "run.mp4", "donkey", replace(ROAD, lane_width=lane_width), [seen], [])
    frame = cv2.VideoCapture(str(tmp_path / "run.mp4")).read()[1][..., ::-1].astype(float)
    assert (np.abs(frame[366, 960 + 208] - rgb(PASS)).max() < 60.0) == full


def test_a_bad_place_for_a_video_is_named(tmp_path: Path) -> None:
    with pytest.raises(VideoError, match="ends with .mp4"):
        check_path(tmp_path / "run.avi")
    with pytest.raises(VideoError, match="is not a folder"):
        check_path(tmp_path / "none" / "run.mp4")
