# SPDX-License-Identifier: Apache-2.0
"""Roads driven on several simulators: what is kept of a stopped comparison, and what it refuses to mix."""

from __future__ import annotations

import logging
from collections.abc import Callable
from contextlib import nullcontext
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from made_observations import made_observation

from ds_base.folder_files import StoreError
from ds_base.progress import LOGGER
from ds_driver.closed_loop.simulation import DriveRequest
from ds_driver.networks.driver_name import AUTOPILOT, DriverName
from ds_orchestrator.campaign.config import ConfigError
from ds_orchestrator.campaign.engine import DriveSettings, Watch
from ds_orchestrator.campaign.executor import Stopped
from ds_orchestrator.engines import drive_tests, fingerprint
from ds_orchestrator.engines.drive_tests import Callbacks
from ds_orchestrator.engines.start import ENGINES
from ds_road import Road, generate
from ds_sim import BULLET, DONKEY
from ds_sim.session import RunRecord
from ds_sim.simulator import Command, Outcome, Reason
from ds_studies.same_roads import drive_same_roads

ROADS = tuple(generate(np.random.default_rng(seed)) for seed in range(4))
ENDS = (Outcome.COMPLETED, Outcome.OUT_OF_BOUNDS, Outcome.SIM_ERROR, Outcome.COMPLETED)
OUTCOMES = dict(zip(ROADS, ENDS, strict=True))
SETTINGS = DriveSettings(siblings=(BULLET, DONKEY), driver=AUTOPILOT, retries=0)


class MadeUpEngine:
    """Drives nothing, one road at a time; the user stops it after some drives."""

    capacity = 1

    def __init__(self, most: int = 99) -> None:
        self.driven: list[tuple[str, Road, int]] = []
        self._most = most

    def drive(self, request: DriveRequest, watch: Watch | None = None) -> RunRecord:
        if len(self.driven) == self._most:
            raise KeyboardInterrupt
        self.driven.append((request.simulator, request.road, request.seed))
        run = request.ended(OUTCOMES[request.road], "")
        for step, (x, y) in enumerate(request.road.lane_centre[:40].tolist()):
            run.observations.append(made_observation(step, x=x, y=y))
        run.commands.extend([Command(0.0, 0.0)] * 39)
        return run

    def stop(self) -> None: ...


Use = Callable[[MadeUpEngine], MadeUpEngine]


@pytest.fixture
def use(monkeypatch: pytest.MonkeyPatch) -> Use:
    """Makes an engine the one that is started next."""

    def used(engine: MadeUpEngine) -> MadeUpEngine:
        monkeypatch.setitem(ENGINES, "local", lambda *_: nullcontext(engine))
        return engine

    return used


def test_a_stopped_comparison_drives_only_what_is_missing(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture, use: Use
) -> None:
    callbacks = Callbacks()
    caplog.set_level(logging.INFO, LOGGER)
    use(MadeUpEngine(most=3))
    with pytest.raises(Stopped):
        drive_same_roads(SETTINGS, ROADS[:3], 7, tmp_path / "drives", callbacks)
    engine = use(MadeUpEngine())
    found = drive_same_roads(SETTINGS, ROADS[:3], 7, tmp_path / "drives", callbacks)
    assert engine.driven == [("donkey", ROADS[1], 8), ("bullet", ROADS[2], 9), ("donkey", ROADS[2], 9)]
    for runs in found.values():
        assert [run.outcome for run in runs] == [OUTCOMES[road] for road in ROADS[:3]]
        assert [run.road for run in runs] == list(ROADS[:3])
        assert runs[0].max_lateral_position == 0.25 and set(runs[0].profile) == {0.25} and not len(runs[2].profile)
        np.testing.assert_array_equal(runs[1].path, ROADS[1].lane_centre[:40])
    # Errors are driven again, and so are other roads and other seeds.
    engine = use(MadeUpEngine())
    drive_same_roads(SETTINGS, ROADS, 7, tmp_path / "drives", callbacks)
    assert engine.driven == [(name, ROADS[k], 7 + k) for k in (2, 3) for name in ("bullet", "donkey")]
    engine = use(MadeUpEngine())
    drive_same_roads(SETTINGS, ROADS[:1], 8, tmp_path / "drives", callbacks)
    assert len(engine.driven) == 2 and not caplog.messages
    monkeypatch.setattr(drive_tests, "code_sha256", lambda: "0")
    drive_same_roads(SETTINGS, ROADS[:1], 8, tmp_path / "drives", callbacks)
    assert len(engine.driven) == 2 and "the code has changed" in caplog.text and len(caplog.messages) == 1
    assert fingerprint.code_sha256() != "0"


def test_drives_of_another_driver_or_of_other_weights_are_refused(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, use: Use
) -> None:
    use(MadeUpEngine())
    network = replace(SETTINGS, driver=DriverName("dave2_short"))
    drive_same_roads(network, ROADS[:1], 7, tmp_path / "drives", Callbacks())
    with pytest.raises(StoreError, match=r"driver.*choose another --out"):
        drive_same_roads(SETTINGS, ROADS[:1], 7, tmp_path / "drives", Callbacks())
    monkeypatch.setattr("ds_driver.networks.network_driver.driver_sha256", lambda driver: "0")
    with pytest.raises(ConfigError, match=r"the weights of dave2_short have changed since .*: choose another --out"):
        drive_same_roads(network, ROADS[:1], 7, tmp_path / "drives", Callbacks())


def test_without_a_folder_nothing_is_kept(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, use: Use) -> None:
    monkeypatch.chdir(tmp_path)
    for _ in range(2):
        engine = use(MadeUpEngine())
        assert len(drive_same_roads(SETTINGS, ROADS[:1], 7, None, Callbacks())[DONKEY]) == 1
        assert len(engine.driven) == 2
    assert not list(tmp_path.iterdir())


class RefusingEngine(MadeUpEngine):
    """One of whose simulators cannot realise a road."""

    def drive(self, request: DriveRequest, watch: Watch | None = None) -> RunRecord:
        if (request.simulator, request.road) == ("donkey", ROADS[0]):
            return request.ended(Outcome.SIM_ERROR, "no such lane here", Reason.NOT_APPLICABLE)
        return super().drive(request, watch)


def test_roads_stay_in_line_where_a_simulator_cannot_realise_one(tmp_path: Path, use: Use) -> None:
    use(RefusingEngine())
    found = drive_same_roads(SETTINGS, ROADS[:2], 7, tmp_path / "drives", Callbacks())
    assert [run.road for run in found[DONKEY]] == list(ROADS[:2])
    assert [run.outcome for run in found[DONKEY]] == [Outcome.SIM_ERROR, Outcome.OUT_OF_BOUNDS]
    assert [run.outcome for run in found[BULLET]] == [Outcome.COMPLETED, Outcome.OUT_OF_BOUNDS]
