# SPDX-License-Identifier: Apache-2.0
"""Simulator names that come from a file of somebody else never import code that is not shipped."""

from __future__ import annotations

import sys
from pathlib import Path

import pytest

from ds_sim.registry import FOREIGN, SIMULATORS, UntrustedSimulatorError, received_simulator


def test_shipped_names_pass_with_and_without_a_parameter_file() -> None:
    for name in {*SIMULATORS, *SIMULATORS.values(), "donkey@car.yaml"} - FOREIGN:
        assert received_simulator(name) == name


@pytest.mark.parametrize(
    "name",
    ["evilmod:S", "donkey:S", "ds_sim.registry:Simulator", "Donkey", "", "evil\nmod:S", "a" * 100_000 + ":S", 3, None],
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
