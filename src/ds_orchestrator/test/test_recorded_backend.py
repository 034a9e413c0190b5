# SPDX-License-Identifier: Apache-2.0
"""What began on one back end of the network goes on with it, whatever `auto` is later."""

from __future__ import annotations

from contextlib import closing
from dataclasses import replace
from pathlib import Path

import pytest

from ds_driver.networks import network_driver
from ds_driver.networks.driver_name import DriverName
from ds_orchestrator.campaign.config import parse_config
from ds_orchestrator.campaign.folder import BACKEND, DRIVER_SHA256, CampaignData, record_provenance
from ds_orchestrator.store.store import Store


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
