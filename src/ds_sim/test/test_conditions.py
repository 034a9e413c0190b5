# SPDX-License-Identifier: Apache-2.0
"""Conditions as values, as text and in commands; when a run ends: positions, verdicts, spoilt commands, late frames."""

from __future__ import annotations

import json
import math
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from ds_sim.conditions.actuation import Actuation
from ds_sim.conditions.model import DEFAULT, FIELDS, Conditions, ConditionsError, NotApplicableError
from ds_sim.conditions.text import PHRASES, Side, conditions_in_words, format_conditions, from_json, parse_conditions
from ds_sim.oracle import LaneTracker, Oracle, OracleLimits
from ds_sim.registry import make_simulator, simulator_of_process
from ds_sim.ros.command_monitor import WARN_AFTER, CommandMonitor
from ds_sim.ros.real_time_loop import FrameJitter
from ds_sim.scenario import Scenario
from ds_sim.session import Session
from ds_sim.simulator import FRAME_TIME, Command, CommandError, Outcome, Reason
from ds_sim.testing import STRAIGHT


def test_the_default_changes_nothing_and_has_no_text() -> None:
    assert DEFAULT.is_default and not DEFAULT.changed and format_conditions(DEFAULT) == ""
    assert parse_conditions("") == parse_conditions("friction=1,exposure=1.0") == DEFAULT


def test_text_and_json_keep_every_bit() -> None:
    given = Conditions(line_contrast=0.1 + 0.2, visibility=40, camera_pitch=math.radians(4), friction=1 / 3)
    assert parse_conditions(format_conditions(given)) == given
    assert from_json(json.loads(json.dumps(given.changed))) == given
    assert parse_conditions("camera_pitch=4deg, speed_limit=18km/h") == Conditions(
        camera_pitch=math.radians(4), speed_limit=5.0
    )
    assert repr(Conditions(tyre_pull=-0.0)) == repr(DEFAULT)


@pytest.mark.parametrize("name", FIELDS)
def test_both_ends_of_a_range_are_allowed_and_nothing_beyond(name: str) -> None:
    condition, with_it = FIELDS[name], {"shadow_depth": "shadow_density", "line_cover_length": "line_cover"}
    others: dict[str, float] = {with_it[name]: 0.5} if name in with_it else {}
    for value in (condition.low, condition.high):
        assert getattr(Conditions(**others, **{name: value}), name) == value
    for value in {condition.low - 0.01, condition.high + 0.01, math.nan, -math.inf} - {math.inf}:
        with pytest.raises(ConditionsError, match=f"^{name} is .*, expected {condition.low:g}"):
            Conditions(**others, **{name: value})


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("weather=3", "unknown condition 'weather': expected some of line_contrast, "),
        ("fog=3", "unknown condition 'fog': did you mean visibility (20 m or more)?"),
        ("Rain=3", "unknown condition 'Rain': did you mean visibility (20 m or more) or friction (0.1 to 1)?"),
        ("visibilti=60", "unknown condition 'visibilti': did you mean visibility (20 m or more)?"),
        ("command-delay=1", "unknown condition 'command-delay': did you mean command_delay (0 to 1 s)?"),
        ("visibility", "visibility has no value, expected visibility=NUMBER: 20 m or more"),
        ("visibility=thick", "visibility is 'thick', expected 20 m or more"),
        ("visibility=0.001", "visibility is 0.001, expected 20 m or more"),
        ("command_delay=120", "command_delay is 120, expected 0 to 1 s"),
        ("steering_lag=inf", "steering_lag is inf, expected 0 to 1 s"),
        ("friction=4deg", "friction is '4deg', expected 0.1 to 1"),
        ("friction=1,friction=1", "friction is given twice: give it once"),
        ("shadow_depth=0.5", "shadow_depth is 0.5 without shadows: give shadow_density too"),
        ("line_cover_length=5", "line_cover_length is 5 m without line_cover: give line_cover too"),
        ("a=" * 5000, "conditions of 10000 characters, expected at most 4096"),
    ],
)
def test_bad_text_gets_one_line(text: str, message: str) -> None:
    with pytest.raises(ConditionsError) as caught:
        parse_conditions(text)
    assert str(caught.value).startswith(message) and "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("word", "meant"),
    [
        ("dark", "illuminance"), ("night", "illuminance"), ("sun", "low_sun"), ("glare", "low_sun"),
        ("latency", "command_delay"), ("dirt", "lens_dirt"), ("noise", "sensor_noise"), ("shadow", "shadow_density"),
        ("ice", "friction"), ("linecontrast", "line_contrast"), ("camera_roll", "camera_"),
    ],
)  # fmt: skip
def test_a_colloquial_or_misspelt_condition_gets_its_neighbour(word: str, meant: str) -> None:
    with pytest.raises(ConditionsError, match=f"did you mean .*{meant}"):
        parse_conditions(f"{word}=1")


@pytest.mark.parametrize("document", [[], "friction", {"friction": "low"}, {"friction": True}, {1: 2.0}])
def test_bad_json_gets_one_line(document: Any) -> None:
    with pytest.raises(ConditionsError):
        from_json(document)


def reached(conditions: Conditions, frames: int, *, speed: float = 0.0) -> list[Command]:
    """What a vehicle with wheels that turn by 0.5 rad executes of a step to full lock and throttle."""
    actuation = Actuation(conditions, max_steering_angle=0.5)
    return [actuation.reached(Command(1.0, 1.0), speed) for _ in range(frames)]


@pytest.mark.parametrize("delay", [0.05, 0.3, 0.32, 1.0])
def test_a_delay_takes_its_time(delay: float) -> None:
    for values in zip(*((c.steering, c.throttle) for c in reached(Conditions(command_delay=delay), 30)), strict=True):
        assert FRAME_TIME * sum(1.0 - value for value in values) == pytest.approx(delay, abs=1e-6)


@pytest.mark.parametrize("lag", [0.05, 0.3, 1.0])
def test_a_lag_is_the_time_to_63_percent(lag: float) -> None:
    commands = reached(Conditions(steering_lag=lag), 200)
    middles = [(k + 0.5) * FRAME_TIME for k in range(200)]
    for time, command in zip(middles, commands, strict=True):
        assert command.steering == pytest.approx(1.0 - math.exp(-time / lag), abs=1e-9)
        assert command.throttle == 1.0


def test_a_pull_turns_the_wheels_left() -> None:
    actuation = Actuation(Conditions(tyre_pull=0.05), max_steering_angle=0.5)
    assert actuation.reached(Command(0.0, 0.5), 1.0) == Command(-0.1, 0.5)


def test_a_speed_limit_cuts_the_throttle_off() -> None:
    limit = Conditions(speed_limit=5.0)
    assert [reached(limit, 1, speed=v)[0].throttle for v in (4.0, 4.75, 5.0, 9.0)] == pytest.approx([1.0, 0.5, 0, 0])


def test_a_simulator_without_conditions_goes_on_working(monkeypatch: pytest.MonkeyPatch) -> None:
    foreign = make_simulator("donkey")
    spec = replace(foreign.spec, name="foreign", conditions=())
    monkeypatch.setattr(type(foreign), "spec", property(lambda _: spec))
    session = Session(foreign)
    assert session.start(Scenario(STRAIGHT, seed=1)) is not None
    with pytest.raises(NotApplicableError, match="^foreign cannot realise friction: it realises none$"):
        session.start(Scenario(STRAIGHT, Conditions(friction=0.5), seed=1))
    assert session.run is not None and session.run.outcome is Outcome.RUNNING  # no run was made of that
    foreign.close()


def test_a_kept_simulator_draws_all_rows_again() -> None:
    kept = simulator_of_process("bullet")
    kept.draw_rows(0, 1)
    assert not kept.load(STRAIGHT, seed=1).image[1:].any()
    assert simulator_of_process("bullet") is kept
    assert kept.load(STRAIGHT, seed=1).image[-1].any()


def test_every_condition_has_a_phrase_with_its_code_name() -> None:
    assert set(PHRASES) == set(FIELDS)
    for name, field in FIELDS.items():
        text = conditions_in_words(name, field.low, side="or less")
        assert text.count(f"({name}") == 1 and text.endswith(")") and "or " in text


TURNED = "with the camera turned 5.7 degrees {} to the right (camera_yaw -0.1 rad)"


@pytest.mark.parametrize(
    ("name", "value", "side", "said"),
    [
        ("line_cover", 0.26, "or more", "where a quarter or more of the line paint is missing (line_cover 0.26)"),
        ("line_cover", 0.3, "or more", "where 30% or more of the line paint is missing (line_cover 0.3)"),
        ("visibility", 80.0, "or less", "in fog or haze with a visibility of 80 m or less (visibility)"),
        ("camera_yaw", -0.1, "or less", TURNED.format("or more")),
        ("camera_yaw", -0.1, "or more", TURNED.format("or less")),
    ],
)
def test_conditions_in_the_words_of_a_driver(name: str, value: float, side: Side, said: str) -> None:
    assert conditions_in_words(name, value, side=side) == said


def test_right_is_positive_and_arc_length_counts_along_the_line() -> None:
    tracker = LaneTracker(np.array([(0.0, 0.0), (10.0, 0.0), (10.0, 10.0)]))
    assert tracker.length == 20.0
    assert tracker.update(4.0, -1.5) == pytest.approx((1.5, 4.0))
    assert tracker.update(8.0, 0.5) == pytest.approx((-0.5, 8.0))
    assert tracker.update(10.75, 6.0) == pytest.approx((0.75, 16.0))
    assert tracker.lateral_position(9.0, 7.0) == pytest.approx(-1.0)


def test_the_line_is_extended_straight_at_both_ends() -> None:
    tracker = LaneTracker(np.array([(0.0, 0.0), (10.0, 0.0)]))
    assert tracker.update(-3.0, -1.0) == pytest.approx((1.0, -3.0))
    assert tracker.update(13.0, 1.0) == pytest.approx((-1.0, 13.0))


def test_another_part_of_the_road_close_by_is_not_matched() -> None:
    """On a hairpin with legs 6 m apart, a vehicle that drifts sideways is still tracked on the first leg."""
    up = [(0.0, float(y)) for y in range(41)]
    bend = [(3 - 3 * math.cos(a), 40 + 3 * math.sin(a)) for a in np.linspace(0.1, math.pi - 0.1, 12)]
    down = [(6.0, float(y)) for y in range(40, -1, -1)]
    tracker = LaneTracker(np.array([*up, *bend, *down]))
    for step in range(60):
        lateral, arc = tracker.update(step * 0.08, step * 0.3)
        assert lateral == pytest.approx(step * 0.08) and arc == pytest.approx(step * 0.3)


@pytest.mark.parametrize(
    ("distance", "arc", "outcome"),
    [
        (0.5, 10.0, Outcome.RUNNING),
        (0.0, 10.0, Outcome.RUNNING),
        (-1e-9, 10.0, Outcome.OUT_OF_BOUNDS),
        (0.1, 98.0, Outcome.COMPLETED),
        (-0.1, 99.0, Outcome.OUT_OF_BOUNDS),
    ],
)
def test_verdicts_on_one_frame(distance: float, arc: float, outcome: Outcome) -> None:
    assert Oracle(100.0).judge(step=1, lateral_distance=distance, arc_length=arc) is outcome


def test_less_than_a_metre_in_ten_seconds_is_stuck() -> None:
    oracle = Oracle(100.0)
    verdicts = [oracle.judge(step=k, lateral_distance=1.0, arc_length=k * 0.0049) for k in range(201)]
    assert verdicts[:-1] == [Outcome.RUNNING] * 200 and verdicts[-1] is Outcome.STUCK
    oracle = Oracle(100.0)
    assert {oracle.judge(step=k, lateral_distance=1.0, arc_length=k * 0.0051) for k in range(201)} == {Outcome.RUNNING}


def test_reaching_the_maximum_of_steps_is_a_timeout() -> None:
    for oracle, most in ((Oracle(100.0), 2000), (Oracle(100.0, OracleLimits(max_steps=30)), 30)):
        assert oracle.judge(step=most - 1, lateral_distance=1.0, arc_length=1.0) is Outcome.RUNNING
        assert oracle.judge(step=most, lateral_distance=1.0, arc_length=5.0) is Outcome.TIMEOUT


def test_outcomes_are_verdicts_or_errors() -> None:
    assert [o.name for o in Outcome if o.is_failure] == ["OUT_OF_BOUNDS", "STUCK", "TIMEOUT"]
    assert [o.name for o in Outcome if o.is_error] == ["DRIVER_SILENT", "SIM_ERROR", "CANCELLED"]
    assert [o.name for o in Outcome if o.is_verdict] == ["COMPLETED", "OUT_OF_BOUNDS", "STUCK", "TIMEOUT"]


@pytest.mark.parametrize(
    ("sequences", "two"),
    [
        ([1, 2, 3, 4], False),
        ([7, 9, 12], False),  # commands that were lost on the way
        ([40, 41, 1, 2, 3], False),  # restarted during the run
        ([1, 1, 2, 2], True),  # both are new
        ([500, 3, 501, 4], True),  # one of them drove before
        ([5, 6, 7, 1, 8, 2], True),  # the second one joins later
        ([None, None], False),  # a middleware without sequence numbers
    ],
)
def test_two_drivers_are_told_from_one_that_was_restarted(sequences: list[int | None], two: bool) -> None:
    monitor = CommandMonitor()
    for sequence in sequences:
        monitor.command(sequence)
    assert monitor.two_drivers is two


def test_a_driver_that_ignores_images_is_reported_once_and_named_in_the_result() -> None:
    monitor = CommandMonitor()
    monitor.frame(1)
    warnings = [monitor.stray(0) for _ in range(2 * WARN_AFTER)]
    assert warnings.count(True) == 1
    message, reason = monitor.silence(5.0, 7)
    assert reason is Reason.WRONG_STAMP and "header" in message
    assert message.startswith(f"no command within 5 s after frame 7; {2 * WARN_AFTER} commands came")


def test_second_answers_to_the_frame_before_are_no_reason_for_silence() -> None:
    monitor = CommandMonitor()
    monitor.frame(1)
    monitor.frame(1)  # sent again
    monitor.frame(2)
    assert not monitor.stray(1)
    assert monitor.silence(0.5, 0) == ("no command within 0.5 s after frame 0", Reason.NONE)


def test_an_invalid_command_is_the_reason_for_silence() -> None:
    monitor = CommandMonitor()
    monitor.frame(1)
    monitor.stray(0)
    monitor.refused(CommandError("steering is nan"))
    assert monitor.silence(2.0, 1) == (
        "no command within 2 s after frame 1; the last command was refused: steering is nan",
        Reason.COMMAND_REFUSED,
    )


def test_lateness_and_missed_beats() -> None:
    """Frames 1, 2, 3 and 1 ms late; two frames were missed between the second and the third."""
    jitter = FrameJitter(0.05, 100.0)
    for now in (100.051, 100.102, 100.253, 100.301):
        jitter.beat(now)
    assert jitter.missed == 2
    assert jitter.lateness(1.0) == pytest.approx(0.003, abs=1e-9)
    assert jitter.lateness(0.5) == pytest.approx(0.0015, abs=1e-9)
    assert str(jitter).startswith("real time: 4 frames at 20 Hz, late by 1.5 ms in the median")
    assert str(jitter).endswith("3.0 ms at worst; 2 frames missed")


def test_lateness_is_zero_before_the_first_beat() -> None:
    assert FrameJitter(0.05, 0.0).lateness(1.0) == 0.0
