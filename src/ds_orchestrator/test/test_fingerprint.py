# SPDX-License-Identifier: Apache-2.0
"""What machines must have in common to drive for one campaign."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest

from ds_orchestrator.engines import fingerprint as module
from ds_orchestrator.engines.fingerprint import PROCESSOR_FEATURES, differences, fingerprint
from ds_sim.registry import UnknownSimulatorError, spec_of
from ds_sim.simulator import SimulatorError, SimulatorSpec
from ds_sim_panda.scene import graphics


def test_the_renderer_counts_where_panda_drives(monkeypatch: pytest.MonkeyPatch) -> None:
    here = fingerprint("", ("bullet", "panda"))
    assert here["renderer"].startswith("Mesa ") and differences(here, here) == ""

    def missing() -> str:
        raise SimulatorError("libEGL.so.1 is missing")

    monkeypatch.setattr(graphics, "renderer_name", missing)
    assert differences(here, fingerprint("", ("panda",))) == f"renderer absent there, {here['renderer']} here"
    assert not {"renderer", "panda3d"} & set(fingerprint("onnx", ("bullet", "donkey")))


def test_torcs_and_its_renderer_count_where_it_drives(monkeypatch: pytest.MonkeyPatch) -> None:
    def missing(name: str) -> SimulatorSpec:
        raise UnknownSimulatorError(f"there is no host of {name}")

    monkeypatch.setattr(module, "spec_of", missing)
    assert fingerprint("", ("torcs",))["TORCS"] == "absent" and "TORCS" not in fingerprint("", ("bullet", "panda"))
    engine = replace(spec_of("bullet"), engine="TORCS 1.3.7 on Mesa")
    monkeypatch.setattr(module, "spec_of", lambda name: engine)
    there = fingerprint("", ("ds_sim_torcs.simulator:TorcsSimulator",))
    assert there["TORCS"] == "TORCS 1.3.7 on Mesa"


def test_a_difference_in_processor_features_names_only_what_one_side_lacks() -> None:
    here, there = {"processor features": "avx avx2 fma"}, {"processor features": "avx fma sve"}
    assert differences(here, there) == "processor features without avx2 and with sve"


def test_only_processor_features_that_round_the_networks_back_end_count(tmp_path: Path) -> None:
    """A newer processor with AVX-512 gives the same bits, also where its formats for networks are others."""
    older, newer, arm = (tmp_path / name for name in ("older", "newer", "arm"))
    older.write_text("flags\t\t: sse2 fma avx2 avx512f avx512vl avx512_bf16\n")
    newer.write_text("flags\t\t: sse2 fma avx2 avx512f avx512vl avx512_vp2intersect avx_vnni\n")
    arm.write_text("Features\t: asimd sve\n")
    features = module._processor_features
    assert features("onnx", older) == features("", newer) == "avx2 avx512f avx512vl fma"
    assert features("openvino-bf16", older) != features("openvino-bf16", newer)
    assert features("onnx", arm) == "asimd sve"
    assert fingerprint("onnx", ())[PROCESSOR_FEATURES] == features("onnx")


def test_the_libraries_of_a_networks_back_end_count() -> None:
    assert {"openvino", "onnxruntime"} <= fingerprint("openvino-int8", ()).keys()
    assert "onnxruntime" not in fingerprint("openvino-bf16", ())
