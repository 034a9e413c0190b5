# SPDX-License-Identifier: Apache-2.0
"""Simulator names that come from a file of somebody else never import code that is not shipped."""

from __future__ import annotations

import sys
from pathlib import Path

import pytest
from installed_package import installed_package

from ds_sim.registry import (
    SIMULATORS,
    UntrustedSimulatorError,
    make_simulator,
    received_simulator,
    simulators,
    unknown_simulator,
)


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


def test_a_plugin_of_the_checkout_that_is_not_installed_is_named_with_what_installs_it() -> None:
    line = unknown_simulator("torcs")
    assert "expected one of bullet," in line and line.endswith(
        "plugins/ds_sim_torcs of this checkout has it: type make torcs"
    )
