# SPDX-License-Identifier: Apache-2.0
"""What others send: runs arrive with every bit or are refused, and simulators' names import nothing unconfirmed."""

from __future__ import annotations

import json
import math
import sys
from contextlib import suppress
from dataclasses import fields
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from installed_package import installed_package
from tests.observations import made_observation

from ds_road import Road
from ds_sim.conditions.model import Conditions
from ds_sim.registry import (
    SIMULATORS,
    UnknownSimulatorError,
    UntrustedSimulatorError,
    make_simulator,
    received_simulator,
    simulators,
    unknown_simulator,
)
from ds_sim.run_codec import RunCodecError, decode_run, encode_run
from ds_sim.scenario import MAX_SEED, Scenario
from ds_sim.session import NO_IMAGE, RunRecord
from ds_sim.simulator import Command, LaneState, Observation, Outcome, Reason, VehicleState

ROAD = Road([(0.0, 0.0), (10.0, 0.0), (30.0, 0.0), (60.0, 20.0), (90.0, 20.0)])
OTHER_ROAD = Road([(0.0, 0.0), (10.0, 0.0), (30.0, 0.0), (60.0, 20.0), (90.0, 21.0)])

numbers = st.floats(allow_nan=False, allow_infinity=False)
observations = st.builds(
    Observation,
    image=st.just(NO_IMAGE),
    step=st.integers(0, 2**32 - 1),
    time=numbers,
    vehicle=st.builds(VehicleState, **{field.name: numbers for field in fields(VehicleState)}),
    lane=st.builds(LaneState, **{field.name: numbers for field in fields(LaneState)}),
    outcome=st.sampled_from(Outcome),
)
commands = st.builds(Command, steering=st.floats(-1.0, 1.0), throttle=st.floats(0.0, 1.0))


@st.composite
def runs(draw: st.DrawFn) -> RunRecord:
    seen = draw(st.lists(observations, max_size=4))
    driven = max(0, len(seen) - 1)
    return RunRecord(
        scenario=Scenario(ROAD, seed=draw(st.integers(0, MAX_SEED))),
        observations=seen,
        commands=draw(st.lists(commands, min_size=driven, max_size=driven)),
        outcome=draw(st.sampled_from(Outcome)),
        message=draw(st.text(max_size=40)),
        reason=draw(st.sampled_from(Reason)),
    )


def a_run(**of_vehicle: Any) -> RunRecord:
    return RunRecord(
        scenario=Scenario(ROAD, seed=7),
        observations=[made_observation(step, **of_vehicle) for step in range(2)],
        commands=[Command(-0.5, 0.25)],
        outcome=Outcome.COMPLETED,
        message="é",
    )


@settings(deadline=None)  # a busy machine is slow
@given(runs())
def test_a_run_arrives_with_every_bit(run: RunRecord) -> None:
    arrived = decode_run(encode_run(run), Scenario(ROAD, seed=run.seed))
    assert repr(arrived) == repr(run)  # repr tells -0.0 from 0.0, and a numpy number from a Python one


def test_numbers_of_numpy_arrive_as_python_numbers() -> None:
    run = a_run(x=np.float64(0.1), y=np.float32(0.1))
    vehicle = decode_run(encode_run(run), Scenario(ROAD, seed=7)).observations[0].vehicle
    assert (repr(vehicle.x), repr(vehicle.y)) == ("0.1", repr(float(np.float32(0.1))))


@settings(max_examples=300)
@given(st.data())
def test_damage_is_refused_in_one_line(data: st.DataObject) -> None:
    whole = encode_run(a_run())
    kind = data.draw(st.sampled_from(["cut", "longer", "bit", "anything"]))
    if kind == "cut":
        damaged = whole[: data.draw(st.integers(0, len(whole) - 1))]
    elif kind == "longer":
        more = st.binary(min_size=1, max_size=40)
        damaged = whole + data.draw(more.filter(lambda added: added.strip(b" \t\r\n")))  # JSON may end in blanks
    elif kind == "bit":
        at = data.draw(st.integers(0, len(whole) - 1))
        damaged = whole[:at] + bytes([whole[at] ^ 1 << data.draw(st.integers(0, 7))]) + whole[at + 1 :]
    else:
        damaged = data.draw(st.binary(max_size=200))
    if kind == "bit":  # another number is a run, too: the connection answers for the bytes
        with suppress(RunCodecError):
            decode_run(damaged, Scenario(ROAD, seed=7))
        return
    with pytest.raises(RunCodecError) as refused:
        decode_run(damaged, Scenario(ROAD, seed=7))
    assert len(str(refused.value).splitlines()) == 1


@pytest.mark.parametrize(
    "asked", [Scenario(OTHER_ROAD, seed=7), Scenario(ROAD, seed=8), Scenario(ROAD, Conditions(friction=0.5), seed=7)]
)
def test_the_answer_to_another_request_is_refused(asked: Scenario) -> None:
    with pytest.raises(RunCodecError, match="another road, seed or conditions"):
        decode_run(encode_run(a_run()), asked)


@pytest.mark.parametrize(
    ("path", "value", "line"),
    [
        ((2,), 99, "2: Input should be 0, 1"),
        ((3,), 99, "3: Input should be 0, 1"),
        ((5,), [], "2 frames and 0 commands"),
        ((1, 0, 2, "x"), math.nan, "vehicle.x is nan in frame 0"),
        ((1, 1, 3, "arc_length"), math.inf, "lane.arc_length is inf in frame 1"),
        ((1, 0, 2, "x"), "far", "1.0.2.x: Input should be a valid number"),
        ((1, 0, 0), -1, "1.0.0: Input should be greater than or equal to 0"),
        ((5, 0, "steering"), 1.5, "steering is 1.5"),
        ((4,), 7, "4: Input should be a valid string"),
        ((4,), "x" * 70_000, "at most 65536 characters"),
        ((6,), [math.nan], "visible_contrast is nan"),
    ],
)
def test_content_that_makes_no_sense_is_refused_by_name(path: tuple[Any, ...], value: object, line: str) -> None:
    sent = json.loads(encode_run(a_run()))
    *parents, last = path
    part = sent
    for one in parents:
        part = part[one]
    part[last] = value
    with pytest.raises(RunCodecError, match=line):
        decode_run(json.dumps(sent).encode(), Scenario(ROAD, seed=7))


def test_contrasts_of_lines_arrive() -> None:
    measured = a_run()
    measured.visible_contrasts = [0.5, 0.0, 1 / 3]
    arrived = decode_run(encode_run(measured), Scenario(ROAD, seed=7))
    assert arrived.visible_contrasts == measured.visible_contrasts and arrived.message == measured.message
    measured.visible_contrasts = [math.nan]
    with pytest.raises(RunCodecError, match="visible_contrast is nan"):
        encode_run(measured)


def test_what_nobody_could_read_is_not_sent() -> None:
    with pytest.raises(RunCodecError, match=r"vehicle\.roll is nan in frame 0"):
        encode_run(a_run(roll=math.nan))
    with pytest.raises(RunCodecError, match="expected one command between two"):
        encode_run(RunRecord(scenario=Scenario(ROAD, seed=1), commands=[Command(0.0, 0.0)]))
    with pytest.raises(RunCodecError, match="expected at most"):
        encode_run(RunRecord(scenario=Scenario(ROAD, seed=1), message="x" * 70_000))
    with pytest.raises(RunCodecError, match="cannot be sent: must be real number, not str"):
        encode_run(a_run(roll="0"))


def test_shipped_names_pass_with_and_without_a_parameter_file() -> None:
    for name in {*SIMULATORS, *SIMULATORS.values(), "donkey@car.yaml"} - {"ros", SIMULATORS["ros"]}:
        assert received_simulator(name) == name


@pytest.mark.parametrize(
    "name",
    [
        "recording@folder",
        f"{SIMULATORS['recording']}@folder",
        "evilmod:S",
        "donkey:S",
        "ds_sim.registry:Simulator",
        "Donkey",
        "",
        "evil\nmod:S",
        "a" * 100_000 + ":S",
        3,
        None,
    ],
)
def test_any_other_name_is_refused_in_one_line(name: object) -> None:
    with pytest.raises(UntrustedSimulatorError) as refused:
        received_simulator(name)
    assert "\n" not in str(refused.value) and len(str(refused.value)) < 500


def test_only_exactly_the_confirmed_name_is_let_through(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "evilmod.py").write_text("raise SystemExit('imported')\n")
    monkeypatch.syspath_prepend(str(tmp_path))
    with pytest.raises(UntrustedSimulatorError, match=r"name it yourself with --trust 'evilmod:S'"):
        received_simulator("evilmod:S", confirmed=["evilmod:T", "evilmod"])
    assert received_simulator("evilmod:S", confirmed=["evilmod:S"]) == "evilmod:S"
    assert "evilmod" not in sys.modules


def test_a_simulator_of_an_installed_package_is_made_by_name_and_no_file_of_it_is_trusted(tmp_path: Path) -> None:
    (tmp_path / "their_car.py").write_text("from ds_sim_softbody.simulator import SoftbodySimulator as Car\n")
    with installed_package(tmp_path, "simulators", {"theirs": "their_car:Car"}):
        assert received_simulator("theirs") == "theirs" and "theirs" in simulators()
        assert make_simulator("theirs").spec.name == "softbody"
        with pytest.raises(UntrustedSimulatorError, match="opens a file of its own kind"):
            received_simulator("theirs@file")


@pytest.mark.parametrize("name", ["recording", "ros"])
def test_a_simulator_of_files_says_what_it_needs(name: str) -> None:
    with pytest.raises(UnknownSimulatorError, match=f"simulator '{name}' needs a file or folder: {name}@PATH"):
        make_simulator(name)


def test_a_plugin_of_the_checkout_that_is_not_installed_is_named_with_what_installs_it() -> None:
    line = unknown_simulator("torcs")
    assert "expected one of bullet," in line
    assert line.endswith("plugins/ds_sim_torcs of this checkout has it: type make torcs")
