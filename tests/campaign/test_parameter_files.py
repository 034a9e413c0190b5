# SPDX-License-Identifier: Apache-2.0
"""Files that campaigns name: a fitted car must not change between sessions, and its path may be long.

Paths within a file are relative to that file, wherever `ds` is started; and what is written can be read there.
"""

from __future__ import annotations

import json
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest
import yaml
from tests.campaign.engines import MadeUpEngine
from tests.campaign.test_campaign import ONE, run
from tests.command_line import ds
from tests.fuzz.kinds_campaigns import suite_of

from ds_cli.output import Result
from ds_driver.networks.description import file_of, read_description
from ds_orchestrator.campaign.config import CampaignConfig, ConfigError, read_config
from ds_orchestrator.campaign.executor import Stopped
from ds_orchestrator.engines.cluster import read_cluster
from ds_report.build import write_all
from ds_sim.registry import SimulatorName, label_of, make_simulator
from ds_studies.suite_file import read_suite, write_suite
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
