# SPDX-License-Identifier: Apache-2.0
"""Campaigns whose twin is a fitted car: its file must not change between sessions, and its path may be long."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest
from tests.campaign.engines import MadeUpEngine
from tests.campaign.test_campaign import ONE, run

from ds_orchestrator.campaign.config import CampaignConfig, ConfigError
from ds_orchestrator.campaign.executor import Stopped
from ds_report.build import write_all
from ds_sim.registry import SimulatorName, label_of
from ds_studies.whole_campaign import run_campaign

CAR = "format: ds_twin_donkey parameters 1\nparameters: {friction: {value: 0.8}}\n"


def config_with(file: Path) -> CampaignConfig:
    file.write_text(CAR)
    return ONE.model_copy(update={"twin": SimulatorName(f"donkey@{file}"), "record": "telemetry", "retries": 0})


def test_a_campaign_does_not_go_on_with_another_car(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    @contextmanager
    def stopped(*_: object, **__: object) -> Iterator[None]:
        raise KeyboardInterrupt
        yield

    monkeypatch.setattr("ds_orchestrator.graph.session.running_graph", stopped)
    file = tmp_path / "car.yaml"
    config, out = config_with(file), tmp_path / "out"
    with pytest.raises(Stopped):
        run_campaign(config, out)
    file.write_text(CAR.replace("0.8", "0.7"))
    with pytest.raises(ConfigError, match="the file has changed since .* began: restore it") as caught:
        run_campaign(config, out)
    assert "\n" not in str(caught.value)
    file.write_text(CAR)
    with pytest.raises(Stopped):
        run_campaign(config, out)


def test_bags_maps_and_report_of_a_car_with_a_path(tmp_path: Path) -> None:
    folder = tmp_path / "a car's folder"
    folder.mkdir()
    config, out = config_with(folder / "car.yaml"), tmp_path / "out"
    assert config.twin
    _, store = run(out, MadeUpEngine(), config)
    bags = [out / execution.bag for execution in store.executions()]
    assert len(bags) == len(set(bags)) == len(store.tests()) * 2
    assert all(bag.parent == out / "bags" and (bag / "metadata.yaml").is_file() for bag in bags)
    report = write_all(out, store)
    assert config.twin.replace("'", "&#39;") in report.read_text()
    pictures = [path.name for path in out.rglob("*.png")]
    assert any("car.yaml" in name for name in pictures), pictures


def test_labels_are_file_names_and_no_two_names_share_one(tmp_path: Path) -> None:
    long = f"donkey@{'/'.join(['folder'] * 60)}"
    alike = ["donkey@a/b.yaml", "donkey@a.b.yaml", "donkey.a.b.yaml", "donkey@\u00e9.yaml"]
    names = [*alike, f"{long}/a", f"{long}/b", "x" * 300]
    labels = [label_of(name) for name in names]
    assert len(set(labels)) == len(names)
    for first in labels:
        for second in labels:
            (tmp_path / f"{first}-0-0001-on-{second}").touch()  # the longest file name with these labels
    assert [label_of(name) for name in ("bullet", "donkey")] == ["bullet", "donkey"]
