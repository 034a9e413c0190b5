# SPDX-License-Identifier: Apache-2.0
"""What machines must have in common to drive for one campaign, and what stays as it was when it began."""

from __future__ import annotations

from contextlib import closing
from dataclasses import replace
from pathlib import Path

import pytest

from ds_driver.networks import network_driver
from ds_driver.networks.driver_name import DriverName
from ds_orchestrator import executables
from ds_orchestrator.campaign.config import parse_config
from ds_orchestrator.campaign.folder import BACKEND, DRIVER_SHA256, CampaignData, record_provenance
from ds_orchestrator.engines import fingerprint as module
from ds_orchestrator.engines.fingerprint import PROCESSOR_FEATURES, differences, fingerprint
from ds_orchestrator.store.store import Store
from ds_sim import BULLET, DONKEY, PANDA, SimulatorName
from ds_sim.simulator import SimulatorError
from ds_sim_panda import simulator


def test_the_renderer_counts_where_panda_drives(monkeypatch: pytest.MonkeyPatch) -> None:
    here = fingerprint("", (BULLET, PANDA))
    assert here["renderer"].startswith("Mesa ") and differences(here, here) == ""

    def missing() -> str:
        raise SimulatorError("libEGL.so.1 is missing")

    monkeypatch.setattr(simulator, "graphics", missing)
    assert differences(here, fingerprint("", (PANDA,))) == f"renderer absent there, {here['renderer']} here"
    assert not {"renderer", "panda3d"} & set(fingerprint("onnx", (BULLET, DONKEY)))


def test_code_that_is_not_shipped_counts_by_itself(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    file = tmp_path / "own_car.py"
    file.write_text("from ds_sim_softbody.simulator import SoftbodySimulator\n\nclass Car(SoftbodySimulator): ...\n")
    monkeypatch.syspath_prepend(tmp_path)
    simulators = (SimulatorName("own_car:Car"), BULLET)
    here = fingerprint("", simulators)
    file.write_text(file.read_text() + "# changed\n")
    assert differences(here, fingerprint("", simulators)).startswith("code of own_car ")
    assert fingerprint("", (SimulatorName("nobody:Car"),))["simulator nobody:Car"] == "absent"


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
    known = fingerprint("openvino-bf16", ()).keys()
    assert "openvino" in known and "onnxruntime" not in known


@pytest.mark.parametrize(
    ("driver", "begun", "driven"),
    [
        ("dave2", None, "dave2@openvino"),
        ("dave2", "openvino", "dave2@openvino"),
        ("dave2", "", "dave2@onnx"),  # by a version that recorded none
        ("residual", "", "residual@onnx"),
        ("dave2@openvino", "", "dave2@openvino"),
        ("autopilot", "", "autopilot"),
    ],
)
def test_a_campaign_resumes_on_the_back_end_on_which_it_began(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, driver: str, begun: str | None, driven: str
) -> None:
    config = parse_config({"driver": driver}, "here")
    settings = config.drive_settings()
    with closing(Store(tmp_path / "campaign.sqlite", config=config.identity())) as store:
        if begun is not None and driver != "autopilot":
            store.note(DRIVER_SHA256, network_driver.driver_sha256(config.driver))
        if begun:
            store.note(BACKEND, begun)
        assert record_provenance(store, settings, tmp_path) == replace(settings, driver=DriverName.parse(driven))
        monkeypatch.setattr(network_driver, "default_backend", lambda: "torch")
        assert record_provenance(store, settings, tmp_path).driver == DriverName.parse(driven)
        assert CampaignData(config=config, notes=store.notes()).driver == DriverName.parse(driven)
        assert (BACKEND in store.notes()) == (driven != driver)


def test_an_executable_of_a_package_that_is_not_built_says_how_to_build_it(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(executables, "ABOVE", "not_built.ros.executables")
    said = "orchestrator: not_built is not in this workspace.*--packages-up-to ds_bringup"
    with pytest.raises(SystemExit, match=said):
        executables.orchestrator()
