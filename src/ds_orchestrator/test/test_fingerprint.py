"""What machines must have in common to drive for one campaign."""

from __future__ import annotations

import pytest

from ds_orchestrator.engines.fingerprint import differences, fingerprint
from ds_sim.simulator import SimulatorError
from ds_sim_panda.scene import graphics


def test_the_renderer_counts_where_panda_drives(monkeypatch: pytest.MonkeyPatch) -> None:
    here = fingerprint("", ("bullet", "panda"))
    assert here["renderer"].startswith("Mesa ") and differences(here, here) == ""

    def missing() -> str:
        raise SimulatorError("libEGL.so.1 is missing")

    monkeypatch.setattr(graphics, "renderer_name", missing)
    assert differences(here, fingerprint("", ("panda",))) == f"renderer absent there, {here['renderer']} here"
    assert not {"renderer", "panda3d"} & set(fingerprint("onnx", ("bullet", "donkey")))


def test_a_difference_in_processor_features_names_only_what_one_side_lacks() -> None:
    here, there = {"processor features": "avx avx2 fma"}, {"processor features": "avx fma sve"}
    assert differences(here, there) == "processor features without avx2 and with sve"
