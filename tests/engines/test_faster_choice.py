# SPDX-License-Identifier: Apache-2.0
"""The advice that a campaign prints where it could be faster."""

from __future__ import annotations

from pathlib import Path

import pytest

from ds_driver.networks import backends
from ds_driver.networks.driver_name import DriverName
from ds_orchestrator.engines.preflight import faster_choice


@pytest.mark.parametrize(
    ("driver", "engine", "advice"),
    [
        ("dave2", "graph", "driver dave2@openvino-bf16 and --engine local would take about"),
        ("dave2+indoor_track", "local", "driver dave2+indoor_track@openvino-bf16 would take about"),
        ("dave2@openvino", "graph", ""),
        ("autopilot", "local", ""),
        ("module:Class", "graph", ""),
    ],
)
def test_advice_is_for_networks_that_another_back_end_computes_faster(
    monkeypatch: pytest.MonkeyPatch, driver: str, engine: str, advice: str
) -> None:
    monkeypatch.setattr(backends, "has_bfloat16", lambda: True)
    assert faster_choice(DriverName.parse(driver), engine).startswith(advice)
    assert bool(faster_choice(DriverName.parse(driver), engine)) is bool(advice)


def test_no_advice_without_bfloat16(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "cpuinfo").write_text("flags\t\t: fpu avx2 fma\n")
    assert not backends.has_bfloat16(tmp_path / "cpuinfo")
    monkeypatch.setattr(backends, "has_bfloat16", lambda: False)
    assert faster_choice(DriverName("dave2"), "graph") == ""
