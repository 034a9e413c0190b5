# SPDX-License-Identifier: Apache-2.0
"""Paths within a file are relative to that file, wherever `ds` is started; and what is written can be read there."""

from __future__ import annotations

import json
from pathlib import Path

import pytest
import yaml
from tests.command_line import ds
from tests.fuzz.kinds_suites import suite_of

from ds_cli.output import Result
from ds_driver.networks.description import file_of, read_description
from ds_orchestrator.campaign.config import read_config
from ds_orchestrator.engines.cluster import read_cluster
from ds_sim.registry import make_simulator
from ds_studies.suite.suite_file import read_suite, write_suite

CAR = "format: ds_twin_donkey parameters 1\nparameters: {friction: {value: 0.8}}\n"
NETWORK = "file: weights/mine.onnx\ninput: {size: [66, 200]}\noutputs: {steering: {output: 0}}\n"


@pytest.fixture
def project(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A folder with a network, a fitted car and keys, as seen from another folder."""
    folder = tmp_path / "my project"
    (folder / "nets/weights").mkdir(parents=True)
    (tmp_path / "elsewhere").mkdir()
    texts = {"nets/mine.yaml": NETWORK, "nets/weights/mine.onnx": "", "car.yaml": CAR}
    for name, text in {**texts, **dict.fromkeys(("ca.pem", "cert.pem", "key.pem"), "")}.items():
        (folder / name).write_text(text)
    monkeypatch.chdir(tmp_path / "elsewhere")
    return Path("../my project")


def test_a_campaign_names_network_car_and_generators_beside_it(project: Path) -> None:
    file = project / "campaign.yaml"
    raw = {"driver": "nets/mine.yaml@onnx", "siblings": ["bullet", "donkey@car.yaml"], "twin": "donkey"}
    file.write_text(yaml.safe_dump(raw))
    config = read_config(file)
    assert str(config.driver) == "../my project/nets/mine.yaml@onnx" and config.siblings[0] == "bullet"
    assert config.siblings[1] == "donkey@../my project/car.yaml" and config.twin == "donkey"
    make_simulator(config.siblings[1]).close()
    network = Path(config.driver.network)
    assert file_of(network, read_description(network)).is_file()
    for generators, seen in (("looks", "../my project/looks"), ("none", "none"), ("indoor_track", "indoor_track")):
        file.write_text(f"{{driver: dave2, sim2real: {generators}, twin: 'donkey@{Path.cwd()}/car.yaml'}}")
        config = read_config(file)
        assert str(config.driver) == f"dave2+{seen}" and config.twin == f"donkey@{Path.cwd()}/car.yaml"
    # A name, a class and the autopilot are no files.
    for driver in ("dave2", "dave2@auto", "module:Class", "autopilot"):
        file.write_text(f"driver: '{driver}'")
        assert str(read_config(file).driver) == driver


def test_keys_of_a_cluster_lie_beside_its_file(project: Path) -> None:
    (project / "cluster.yaml").write_text("tls: {ca: ca.pem, cert: cert.pem, key: key.pem}\n")
    tls = read_cluster(project / "cluster.yaml").tls
    assert tls is not None and tls.key.samefile(project / "key.pem")


def test_a_test_writes_a_file_that_is_read_as_what_was_typed(project: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("ds_orchestrator.engines.start.check_driver", lambda *_, **__: None)
    run = Result(document={}, show=lambda: None, next="ds models")
    monkeypatch.setattr("ds_cli.campaign.run.campaign", lambda *_, **__: run)
    typed = ("test", project / "nets/mine.yaml", "--sims", f"bullet,donkey@{project}/car.yaml")
    for folder in (Path("out"), project / "runs"):
        assert ds(*typed, "--out", folder).returncode == 0
        config = read_config(folder / "campaign.yaml")
        assert (str(config.driver), config.twin) == ("../my project/nets/mine.yaml", "donkey@../my project/car.yaml")
    assert "driver: ../nets/mine.yaml " in (project / "runs/campaign.yaml").read_text()


def test_a_suite_finds_the_car_beside_it(project: Path) -> None:
    (project / "suite.json").write_text(json.dumps(suite_of(1, driver="nets/mine.yaml", twin="donkey@car.yaml")))
    suite = read_suite(project / "suite.json")
    assert suite.twin == "donkey@../my project/car.yaml" and set(suite.tests[0].outcomes) == {"bullet", suite.twin}
    make_simulator(suite.twin).close()
    write_suite(suite, Path("moved.json"))
    assert json.loads(Path("moved.json").read_text())["twin"] == suite.twin
    write_suite(suite, project / "again.json")
    assert json.loads((project / "again.json").read_text())["twin"] == "donkey@car.yaml"
    assert read_suite(project / "again.json") == read_suite(Path("moved.json")) == suite
