# SPDX-License-Identifier: Apache-2.0
"""The strength at which a driver first fails, by made-up drivers, and what is kept of a stopped comparison."""

from __future__ import annotations

import logging
import math
from collections.abc import Callable
from contextlib import nullcontext
from dataclasses import replace
from itertools import product
from pathlib import Path
from types import SimpleNamespace
from typing import Protocol, TypeVar

import numpy as np
import pytest
from tests.observations import made_observation

from ds_analysis.sensitivity import (
    LEVELS,
    RESOLUTIONS,
    Factor,
    RoadResult,
    Sensitivity,
    all_factors,
    coverage,
    factors_named,
    threshold_of,
)
from ds_base.folder_files import StoreError, write_json
from ds_base.progress import LOGGER
from ds_driver.closed_loop.simulation import DriveRequest
from ds_driver.networks.driver_name import AUTOPILOT, DriverName
from ds_orchestrator.campaign.config import ConfigError
from ds_orchestrator.campaign.engine import DriveSettings, Watch
from ds_orchestrator.campaign.executor import Stopped
from ds_orchestrator.engines import drive_tests, fingerprint
from ds_orchestrator.engines.drive_tests import Callbacks
from ds_orchestrator.engines.start import ENGINES
from ds_report.sensitivity_page import draw_sensitivity
from ds_road import Road, generate
from ds_sim import BULLET, DONKEY
from ds_sim.conditions.model import DEFAULT, FIELDS, Conditions, ConditionsError
from ds_sim.registry import PANDA, SOFTBODY, SimulatorName
from ds_sim.session import RunRecord
from ds_sim.simulator import Command, Outcome, Reason
from ds_studies import sensitivity
from ds_studies.demo import drive_into_fog
from ds_studies.same_roads import drive_same_roads
from ds_studies.sensitivity import GATE, TESTED, choose_roads, first_failure, measure
from ds_studies.steering_roads import MOST_SEGMENTS, candidate_roads

X = SimulatorName("x")

LAG = next(factor for factor in all_factors() if factor.name == "steering_lag")


def step(threshold: float, driven: list[int] | None = None) -> Callable[[int], bool]:
    """A road that fails from a level on; counts what is driven."""

    def fails(level: int) -> bool:
        if driven is not None:
            driven.append(level)
        return level >= threshold

    return fails


def result(completes: int, fails: int | None = None) -> RoadResult:
    return RoadResult(completes=completes, fails=fails)


@pytest.mark.parametrize("highest", [1, 5, 16])
def test_bisection_finds_every_threshold(highest: int) -> None:
    for threshold in range(1, highest + 2):
        expected = result(threshold - 1, threshold) if threshold <= highest else result(highest)
        assert first_failure(step(threshold), highest) == expected
        for near in range(1, 20):  # a wrong guess costs drives, never the result
            assert first_failure(step(threshold), highest, result(near - 1, near)) == expected
    driven: list[int] = []
    first_failure(step(7, driven), 16)
    assert len(driven) == 5 and driven[0] == 16
    for near, steps in ((7, [7, 6]), (8, [8, 7, 6]), (6, [6, 7]), (9, [9, 8, 7, 5, 6]), (5, [5, 6, 8, 7])):
        driven.clear()
        first_failure(step(7, driven), 16, result(near - 1, near))
        assert driven == steps  # they double
    assert first_failure(step(1), 0) == result(0)


def test_on_a_road_that_is_not_monotone_failing_begins_at_the_result() -> None:
    rng = np.random.default_rng(3)
    for _ in range(200):
        fails = rng.random(17) < 0.5
        found = first_failure(lambda level, fails=fails: bool(fails[level]), 16)  # type: ignore[misc]
        if found.fails is None:
            assert not fails[16]
        else:
            assert found.completes == found.fails - 1 and fails[found.fails]
            assert found.completes == 0 or not fails[found.completes]


def made_up(driver: list[float], gate: float = math.inf) -> sensitivity.Fails:
    """A driver that fails from another steering lag on each road, and a lag from which it cannot be judged."""
    return lambda who, road, conditions: conditions.steering_lag >= (driver[road] if who == TESTED else gate)


def test_the_median_road_decides_and_the_roads_span_the_interval() -> None:
    found = threshold_of(BULLET, LAG, measure(LAG, 5, made_up([0.31, 0.74, 0.49, 2.0, 0.55])))
    assert (found.verdict, found.fails, found.interval) == ("fails", 9, (5, None))
    document = found.document()
    assert (document["first_fails"], document["completes"], document["interval"]) == (0.5625, 0.5, [0.3125, None])
    assert found.text == "0.562 (0.312 to never)" and found.withstood == 0.5625
    noisy = np.random.default_rng(5).normal(0.5, 0.1, (2000, 5))
    medians = [threshold_of(X, LAG, measure(LAG, 5, made_up(list(row)))) for row in noisy[:200]]
    covered = [one.interval[0] <= 8.5 <= (one.interval[1] or 99) for one in medians if one.interval[0]]
    assert abs(np.mean(covered) - coverage(5)) < 0.06 and coverage(5) == 0.9375


def test_fewer_levels_find_the_next_of_their_own() -> None:
    for levels in RESOLUTIONS:
        step = LEVELS // levels
        for fails_from in np.linspace(0.01, 0.99, 40):
            found = threshold_of(X, LAG, measure(LAG, 1, made_up([fails_from]), levels=levels))
            exact = threshold_of(X, LAG, measure(LAG, 1, made_up([fails_from])))
            assert found.fails and exact.fails and found.fails % step == 0
            assert 0 <= found.fails - exact.fails < step
            completed, first = found.document()["completes"], found.document()["first_fails"]
            assert completed < fails_from <= first and first - completed == step / LEVELS


@pytest.mark.parametrize("roads", [1, 3, 4, 5])
def test_no_road_is_driven_that_cannot_change_the_verdict(roads: int) -> None:
    """Whatever roads fail, stopping early gives the verdict that driving all of them gives."""
    for failing in product([False, True], repeat=roads):
        driven: set[int] = set()

        def fails(who: str, road: int, conditions: Conditions, failing=failing, driven=driven) -> bool:  # type: ignore[no-untyped-def]
            driven.add(road)
            return who == TESTED and failing[road] and conditions.steering_lag >= 0.5

        found = threshold_of(X, LAG, measure(LAG, roads, fails))
        assert found.verdict == ("fails" if 2 * sum(failing) >= roads else "completes")
        if found.verdict == "fails":
            assert len(driven) == roads
        if not any(failing):
            assert len(driven) == roads // 2 + 1


def test_never_always_and_infeasible_are_told_apart() -> None:
    never = threshold_of(BULLET, LAG, measure(LAG, 3, made_up([9.0] * 3)))
    assert (never.verdict, never.text, never.withstood, never.fails) == ("completes", "no failure", 1.0, None)
    always = threshold_of(BULLET, LAG, measure(LAG, 3, made_up([0.001] * 3)))
    assert (always.verdict, always.fails, always.document()["completes"]) == ("fails", 1, 0.0)
    # The driver fails from 0.9 s on, where the autopilot fails, too: so it does from 0.5 s on.
    bound = threshold_of(BULLET, LAG, measure(LAG, 3, made_up([0.9] * 3, gate=0.5)))
    assert (bound.verdict, bound.text, bound.fails) == ("infeasible", "infeasible from 0.938", None)
    assert bound.document()["excluded_from"] == 0.9375 and bound.document()["first_fails"] is None
    below = threshold_of(BULLET, LAG, measure(LAG, 3, made_up([0.3] * 3, gate=0.5)))
    assert (below.verdict, below.fails, below.excluded) == ("fails", 5, None)
    # One road fails, one cannot be judged where it would, one passes: the median is not known to pass.
    mixed = [result(3, 4), RoadResult(completes=5, excluded=6), result(LEVELS)]
    assert threshold_of(BULLET, LAG, mixed).text == "infeasible from 0.375"
    assert threshold_of(BULLET, LAG, (), "sim_error: diverged").verdict == "error"


def test_gates_judge_failures_alone() -> None:
    (contrast,) = factors_named(["line_contrast"])
    driven: list[tuple[str, float]] = []

    def drivers(tested: float, visible: float) -> sensitivity.Fails:
        def fails(who: str, _road: int, conditions: Conditions) -> bool:
            driven.append((who, conditions.line_contrast))
            return conditions.line_contrast < {TESTED: tested, GATE: visible}[who]

        return fails

    judged = threshold_of(BULLET, contrast, measure(contrast, 1, drivers(tested=0.5, visible=0.2)))
    assert (judged.verdict, judged.text) == ("fails", "0.438")
    assert [value for who, value in driven if who == GATE] == [0.4375] and driven[0] == (TESTED, 0.0)
    blind = threshold_of(BULLET, contrast, measure(contrast, 3, drivers(tested=0.2, visible=0.5)))
    assert (blind.verdict, blind.text, blind.fails) == ("lines invisible", "lines invisible from 0.188", None)
    driven.clear()
    assert measure(contrast, 2, drivers(tested=-1.0, visible=2.0))[0].withstands_all
    assert {who for who, _ in driven} == {TESTED}  # a pass needs no gate
    assert choose_roads(9, 2, lambda who, road, _: road == 0 or (who == TESTED and road == 1)) == (2, 3)


def test_every_factor_goes_from_the_own_world_to_the_hardest_value() -> None:
    factors = all_factors()
    assert {f.name for f in factors} == {name for name, field in FIELDS.items() if field.stronger}
    for factor in factors:
        values = [factor.value(level) for level in range(LEVELS + 1)]
        steps = np.diff([1.0 / value if factor.name == "visibility" else value for value in values])
        assert (steps > 0).all() or (steps < 0).all()
        assert values[-1] == factor.end and factor.conditions(0) == DEFAULT
        assert getattr(factor.conditions(LEVELS), factor.name) == factor.end
    (fog,) = factors_named(["visibility"])
    assert fog.value(8) == pytest.approx(40.0)  # half the extinction of 20 m
    pitches = factors_named(["camera_pitch"])
    assert [pitch.end for pitch in pitches] == [-0.15, 0.15]
    for bad in (["rain"], ["sun_azimuth"], ["line_cover", "line_cover"]):
        with pytest.raises(ConditionsError, match="expected some of|name each once|did you mean"):
            factors_named(bad)


def test_roads_need_steering_and_fewer_roads_are_the_first_ones() -> None:
    roads = candidate_roads(2, seed=1)
    assert roads[:3] == candidate_roads(1, seed=1) and len({one.road.road_id for one in roads}) == 6
    for road in (one.road for one in roads):
        assert road.validity.valid and 90.0 < road.length < 110.0
        assert np.abs(road.lane_centre[:, 0] - road.lane_centre[0, 0]).max() > 2.0  # it starts northwards
    assert len(candidate_roads(1, seed=1, segments=MOST_SEGMENTS)[0].road.control_points) == 9


class LagEngine:
    """Drives nothing: the driver fails from a lag of 0.3 s on, and the simulator `softbody` from 0.9 s on."""

    capacity = 2

    def __init__(self, *, fails_by_default: bool = False) -> None:
        self.driven: list[tuple[str, str]] = []
        self._fails_by_default = fails_by_default

    def drive(self, request: DriveRequest, watch: Watch | None = None) -> RunRecord:
        self.driven.append((GATE if request.probed else TESTED, request.simulator))
        lag, outcome = request.conditions.steering_lag, Outcome.COMPLETED
        if not request.probed and request.simulator == "softbody" and lag > 0.9:
            return request.ended(Outcome.SIM_ERROR, "")
        if not request.probed and (self._fails_by_default or lag > 0.3):
            outcome = Outcome.OUT_OF_BOUNDS
        return replace(request.ended(outcome, ""), visible_contrasts=[1.0], observations=[made_observation()])

    def stop(self) -> None: ...


E = TypeVar("E")


class Use(Protocol):
    def __call__(self, engine: E) -> E: ...


@pytest.fixture
def use(monkeypatch: pytest.MonkeyPatch) -> Use:
    """Makes an engine the one that is started next, whatever the machine and the weights."""

    def used(engine: E) -> E:
        monkeypatch.setitem(ENGINES, "local", lambda *_: nullcontext(engine))
        return engine

    monkeypatch.setattr(sensitivity, "preflight", lambda settings: None)
    monkeypatch.setattr("ds_driver.networks.network_driver.driver_sha256", str)
    return used


def test_an_analysis_goes_on_where_it_stopped(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, use: Use) -> None:
    realised = {"bullet": tuple(FIELDS), "softbody": tuple(FIELDS), "panda": ("steering_lag",)}
    monkeypatch.setattr(sensitivity, "spec_of", lambda name: SimpleNamespace(conditions=realised[name]))
    factors = factors_named(["line_contrast", "steering_lag"])
    settings = DriveSettings(siblings=(BULLET, SOFTBODY, PANDA), driver=DriverName("dave2"), retries=0)

    def once() -> tuple[Sensitivity, LagEngine]:
        engine = use(LagEngine())
        return sensitivity.analyse_sensitivity(settings, factors, roads=3, seed=1, folder=tmp_path), engine

    found, _ = once()
    assert found.thresholds[1, "bullet"].document()["first_fails"] == 0.3125
    assert found.thresholds[0, "bullet"].verdict == "completes"
    assert found.thresholds[0, "panda"].verdict == "not applicable"
    assert found.thresholds[1, "softbody"].verdict == "error" and len(found.errors) == 1
    assert [factors[position].name for position in found.order] == ["steering_lag", "line_contrast"]
    again, engine = once()
    assert engine.driven == [(TESTED, "softbody")]  # the drive that ended in an error
    assert again.document() == found.document() and again.long_table().csv() == found.long_table().csv()
    assert "the order is that of these 3 roads: on others, another condition may come first" in found.table().notes
    image = draw_sensitivity(found)
    assert image.ndim == 3 and len(np.unique(image.reshape(-1, 3), axis=0)) > 3


def test_a_demo_that_goes_on_knows_its_simulators(tmp_path: Path) -> None:
    (tmp_path / "fog.mp4").touch()
    write_json(tmp_path / "fog.json", {"siblings": ["bullet", "softbody"]})
    assert not any(one.is_external for one in drive_into_fog(tmp_path)["siblings"])


def test_too_few_roads_say_nothing_about_conditions(use: Use) -> None:
    use(LagEngine(fails_by_default=True))
    settings = DriveSettings(siblings=(BULLET,), driver=DriverName("dave2"))
    found = sensitivity.analyse_sensitivity(settings, [LAG], roads=1, seed=1)
    assert found.thresholds[0, "bullet"].text == "fails by default"
    assert "completes 0 of 1 roads without any condition" in found.table().notes[1]


@pytest.mark.parametrize(("driver", "translated"), [("dave2", False), ("dave2_real@openvino-bf16", True)])
def test_thresholds_of_translated_images_say_what_they_are_not(driver: str, translated: bool, use: Use) -> None:
    use(LagEngine())
    settings = DriveSettings(siblings=(BULLET,), driver=DriverName.parse(driver))
    found = sensitivity.analyse_sensitivity(settings, [LAG], roads=1, seed=1)
    assert found.document()["translated_images"] == translated
    assert any("sees translated images" in note for note in found.table().notes) == translated


def test_results_name_values_that_json_can_hold() -> None:
    factor = Factor(name="visibility", start=math.inf, end=20.0)
    document = threshold_of(BULLET, factor, [result(0, 1)]).document()
    assert document["start"] is None and document["completes"] is None and document["first_fails"] == 320.0


ROADS = tuple(generate(np.random.default_rng(seed)) for seed in range(4))
ENDS = (Outcome.COMPLETED, Outcome.OUT_OF_BOUNDS, Outcome.SIM_ERROR, Outcome.COMPLETED)
OUTCOMES = dict(zip(ROADS, ENDS, strict=True))
SETTINGS = DriveSettings(siblings=(BULLET, DONKEY), driver=AUTOPILOT, retries=0)


class RoadsEngine:
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


def test_a_stopped_comparison_drives_only_what_is_missing(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture, use: Use
) -> None:
    callbacks = Callbacks()
    caplog.set_level(logging.INFO, LOGGER)
    use(RoadsEngine(most=3))
    with pytest.raises(Stopped):
        drive_same_roads(SETTINGS, ROADS[:3], 7, tmp_path / "drives", callbacks)
    engine = use(RoadsEngine())
    found = drive_same_roads(SETTINGS, ROADS[:3], 7, tmp_path / "drives", callbacks)
    assert engine.driven == [("donkey", ROADS[1], 8), ("bullet", ROADS[2], 9), ("donkey", ROADS[2], 9)]
    for runs in found.values():
        assert [run.outcome for run in runs] == [OUTCOMES[road] for road in ROADS[:3]]
        assert [run.road for run in runs] == list(ROADS[:3])
        assert runs[0].max_lateral_position == 0.25 and set(runs[0].profile) == {0.25} and not len(runs[2].profile)
        np.testing.assert_array_equal(runs[1].path, ROADS[1].lane_centre[:40])
    # Errors are driven again, and so are other roads and other seeds.
    engine = use(RoadsEngine())
    drive_same_roads(SETTINGS, ROADS, 7, tmp_path / "drives", callbacks)
    assert engine.driven == [(name, ROADS[k], 7 + k) for k in (2, 3) for name in ("bullet", "donkey")]
    engine = use(RoadsEngine())
    drive_same_roads(SETTINGS, ROADS[:1], 8, tmp_path / "drives", callbacks)
    assert len(engine.driven) == 2 and not caplog.messages
    monkeypatch.setattr(drive_tests, "code_sha256", lambda: "0")
    drive_same_roads(SETTINGS, ROADS[:1], 8, tmp_path / "drives", callbacks)
    assert len(engine.driven) == 2 and "the code has changed" in caplog.text and len(caplog.messages) == 1
    assert fingerprint.code_sha256() != "0"


def test_drives_of_another_driver_or_of_other_weights_are_refused(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, use: Use
) -> None:
    use(RoadsEngine())
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
        engine = use(RoadsEngine())
        assert len(drive_same_roads(SETTINGS, ROADS[:1], 7, None, Callbacks())[DONKEY]) == 1
        assert len(engine.driven) == 2
    assert not list(tmp_path.iterdir())


class RefusingEngine(RoadsEngine):
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
