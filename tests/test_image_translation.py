# SPDX-License-Identifier: Apache-2.0
"""Drivers that see pseudo-real images: which generator, which bits, what identifies them, what campaigns check."""

from __future__ import annotations

import json
import shutil
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch
from made_networks import write_generator, write_recorded

from ds_analysis.paper.open_loop import predict
from ds_analysis.paper.paper_tables import network_of
from ds_bags.run_writer import write_bag
from ds_base.progress import SILENT
from ds_driver.data.dataset import DatasetError, decode, keep_import
from ds_driver.data.recordings import Reading, open_recording
from ds_driver.networks import weights
from ds_driver.networks.architectures import NETWORKS
from ds_driver.networks.driver_name import DriverName, received_driver
from ds_driver.networks.images import Crop
from ds_driver.networks.network_driver import NetworkDriver, driver_sha256, generators_of, load_pilot, translation_of
from ds_driver.networks.pilot import NOT_SIMULATED, DriverError, Frame
from ds_driver.networks.torch_networks import make_network, save_weights
from ds_driver.networks.weights import GENERATORS, architecture_in, generators_in, load_weights
from ds_driver.sim2real.generator import Window, load_generator
from ds_driver.sim2real.image_translation import Translator
from ds_driver.sim2real.translation import translate as translate_data
from ds_driver.training import TrainingPlan, train
from ds_orchestrator.campaign.config import CampaignConfig
from ds_orchestrator.engines.dask_worker import parcel_of
from ds_orchestrator.engines.start import check_driver
from ds_road import generate
from ds_sim import BULLET, DONKEY
from ds_sim.camera.encodings import jpeg
from ds_sim.registry import make_simulator
from ds_sim.scenario import Scenario
from ds_sim.session import RunRecord
from ds_sim.simulator import Command, Outcome
from ds_sim.video import compose, write_video
from ship_network import shipped_set_of

WINDOWS = {"bullet": Window(54, 160, 0, 320), "softbody": Window(80, 159, 20, 300)}


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A set of generators of two simulators, and a network that was trained with them beside it."""
    folder = tmp_path_factory.mktemp("stage")
    digests = {
        name: write_generator(folder / GENERATORS / f"{name}.safetensors", name, seed=seed, window=window).sha256
        for seed, (name, window) in enumerate(WINDOWS.items())
    }
    torch.manual_seed(1)
    network = make_network("dave2")
    save_weights(network, folder / "real.safetensors", architecture="dave2", generators=digests)
    save_weights(network, folder / "plain.safetensors", architecture="dave2")
    return folder


def frames(count: int) -> list[Frame]:
    rng = np.random.default_rng(3)
    images = rng.integers(0, 256, (count, 160, 320, 3), dtype=np.uint8)
    names = [*WINDOWS, NOT_SIMULATED]
    return [Frame(image=image, speed=3.0, crop=Crop(54, 0), simulator=names[i % 3]) for i, image in enumerate(images)]


def test_a_network_sees_the_translation_by_the_generator_of_the_frames_simulator(folder: Path) -> None:
    plain = NetworkDriver(str(folder / "plain.safetensors"))
    for name in (f"{folder}/real.safetensors", f"{folder}/plain.safetensors+{folder}/{GENERATORS}"):
        driver = NetworkDriver(name)
        for frame in frames(3):
            assert frame.simulator is not None
            found = driver.command(replace(frame, step=1))
            seen, crop = frame.image, frame.crop
            if frame.simulator != NOT_SIMULATED:
                generator = load_generator(folder / GENERATORS / f"{frame.simulator}.safetensors")
                seen, crop = Translator(generator).translate(frame.image), Crop()
            assert found == plain.command(Frame(image=seen, speed=frame.speed, crop=crop, step=1))
        assert driver.rows_seen(Crop(54, 0), 160, "softbody") == (80, 159)
        assert driver.rows_seen(Crop(54, 0), 160, "donkey") is None
    assert plain.translation is None and plain.rows_seen(Crop(54, 0), 160, "softbody") == (54, 160)


@pytest.mark.parametrize("backend", ["onnx", "openvino", "torch"])
def test_frames_of_several_simulators_are_answered_with_the_bits_of_each_alone(folder: Path, backend: str) -> None:
    if backend.startswith("openvino"):
        pytest.importorskip("openvino")
    driver = NetworkDriver(f"{folder / 'real.safetensors'}@{backend}")
    asked = frames(7)
    alone = [driver.command(replace(f, step=1)) for f in asked]
    assert driver.commands(asked) == alone and len(set(alone)) == 7
    missing = Frame(image=asked[0].image, speed=3.0, simulator="donkey")
    found = driver.commands([asked[0], missing, asked[1]])
    assert [found[0], found[2]] == alone[:2] and isinstance(found[1], DriverError)


def test_what_is_missing_is_named_in_one_line(folder: Path, tmp_path: Path) -> None:
    def check(driver: str, simulators: tuple[str, ...]) -> None:
        generators = generators_of(DriverName.parse(driver))
        assert generators is not None
        for simulator in simulators:
            generators.generator(simulator)

    def refused(driver: object, match: str, *simulators: str) -> None:
        with pytest.raises(DriverError, match=match) as caught:
            check(str(driver), simulators)
        assert "\n" not in str(caught.value)

    refused(
        folder / "real.safetensors", "no generator for images of donkey, it has those of bullet, softbody", "donkey"
    )
    refused(f"dave2+{tmp_path}", "no generators in")
    refused(f"dave2+{tmp_path / 'nowhere'}", "no generators in")
    write_generator(tmp_path / "donkey.safetensors", "bullet")
    refused(f"dave2+{tmp_path}", "translates images of bullet, not of donkey", "donkey")
    (tmp_path / "donkey.safetensors").write_bytes(b"x" * 40)
    refused(f"dave2+{tmp_path}", "damaged", "donkey")
    lone = tmp_path / "lone.safetensors"
    lone.write_bytes((folder / "real.safetensors").read_bytes())
    refused(lone, "trained on images of bullet that a generator translated, which is missing")
    pilot = load_pilot(str(folder / "real.safetensors"))
    with pytest.raises(DriverError, match="does not name its simulator"):
        pilot.predict(replace(frames(1)[0], simulator=None))


def test_a_shipped_set_is_found_by_its_name_and_by_a_networks_generators(
    folder: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(weights, "SHIPPED", tmp_path / "models")
    network = tmp_path / "moved.safetensors"
    network.write_bytes((folder / "real.safetensors").read_bytes())
    digests = generators_in(str(network))
    assert shipped_set_of(digests) is None
    shutil.copytree(folder / GENERATORS, tmp_path / "models" / GENERATORS / "track")
    assert shipped_set_of(digests) == "track" and list(weights.shipped_sets()) == ["track"]
    by_name, by_network = generators_of(DriverName.parse("dave2+track")), generators_of(DriverName.parse(str(network)))
    assert by_name is not None and by_network is not None and by_name.files == by_network.files
    assert all(by_network.generator(name).simulator == name for name in WINDOWS)


def test_another_generator_is_another_driver(folder: Path, tmp_path: Path) -> None:
    write_generator(tmp_path / "bullet.safetensors", seed=7)
    first = driver_sha256(DriverName.parse(f"dave2+{folder / GENERATORS}"))
    assert first == driver_sha256(DriverName.parse(f"dave2+{folder / GENERATORS}@torch"))
    others = [f"dave2+{tmp_path}", "dave2", "dave2+none", f"dave2_short+{tmp_path}"]
    assert len({first, *(driver_sha256(DriverName.parse(name)) for name in others)}) == 5
    translated, plain = (DriverName(str(folder / f"{name}.safetensors")) for name in ("real", "plain"))
    assert driver_sha256(translated) != driver_sha256(plain)


def test_training_on_translated_images_gives_a_network_that_sees_them(folder: Path, tmp_path: Path) -> None:
    rng = np.random.default_rng(1)
    data, real = tmp_path / "data", tmp_path / "data_real"
    for name in WINDOWS:
        for road in ("a", "b"):
            images = [np.full((160, 320, 3), grey, np.uint8) for grey in rng.integers(0, 256, 2)]
            write_recorded(data, name, images, rng.uniform(-1, 1, 2).tolist(), road=road)
    (data / "manifest.json").write_text('{"plan": {"seed": 1}, "images": {"bullet": 4}}')
    for name in WINDOWS:
        translator = Translator(load_generator(folder / GENERATORS / f"{name}.safetensors"))
        translate_data(data, real, translator, SILENT)
    manifest = json.loads((real / "manifest.json").read_text())
    assert manifest["plan"] == {"seed": 1} and manifest["images"] == {"bullet": 4, "softbody": 4}
    plan = TrainingPlan(epochs=1, batch_size=2, validation=0.5, threads=1, device="cpu")
    train(real, tmp_path / "out", plan, SILENT)
    trained = tmp_path / "out" / "dave2.safetensors"
    assert generators_in(str(trained)) == generators_in(str(folder / "real.safetensors"))
    stage = NetworkDriver(str(trained)).translation
    assert stage is not None
    with pytest.deprecated_call():
        assert stage.generators is stage
    image = frames(1)[0].image
    assert np.array_equal(stage.translate(image, "softbody"), translator.translate(image))
    shutil.rmtree(real / "bullet")
    shutil.copytree(data / "bullet", real / "bullet")
    with pytest.raises(DatasetError, match="translated images of softbody and plain ones of bullet"):
        train(real, tmp_path / "mixed", plan, SILENT)


def test_a_bag_and_a_video_show_what_the_driver_saw(folder: Path, tmp_path: Path) -> None:
    driver, road = f"{folder}/real.safetensors", generate(np.random.default_rng(5))
    simulator = make_simulator("bullet")
    seen = [simulator.load(road, seed=1)]
    seen.append(simulator.step(Command(0.0, 1.0)))
    simulator.close()
    run = RunRecord(
        scenario=Scenario(road, seed=1), outcome=Outcome.CANCELLED, observations=seen, commands=[Command(0.0, 1.0)]
    )
    translate = translation_of(DriverName.parse(driver), "bullet")
    assert translate is not None and translation_of(DriverName("dave2"), "bullet") is None
    for name, how in (("plain", None), ("real", translate)):
        write_bag(tmp_path / name, "/ds1", BULLET, run, {"driver": driver}, "raw", seen, how)
    plain, real = (open_recording(tmp_path / name, Reading()) for name in ("plain", "real"))
    topic = "/ds1/sim2real/image_raw"
    translated = open_recording(tmp_path / "real", Reading(camera=topic))
    assert (plain.crop, real.crop, translated.crop) == (Crop(54, 0), Crop(54, 0), Crop())
    assert (real.simulator, translated.simulator) == ("bullet", NOT_SIMULATED)
    for observation, *recorded in zip(seen, plain.frames(), real.frames(), translated.frames(), strict=True):
        images = [frame.image for frame in recorded if frame.image is not None]
        assert np.array_equal(images[0], observation.image) and np.array_equal(images[1], observation.image)
        assert np.array_equal(images[2], translate(observation.image))
    panel = np.zeros((480, 300, 3), np.uint8)
    picture = compose(seen[0], panel, translate(seen[0].image))
    assert picture.shape == (640, 940, 3) and compose(seen[0], panel).shape == (480, 1260, 3)
    write_video(tmp_path / "v.mp4", "bullet", road, seen, run.commands, translate=translate)
    frames_there, first = cv2.VideoCapture(str(tmp_path / "v.mp4")).read()
    assert frames_there and first.shape == picture.shape
    assert np.abs(first[:, :640, ::-1].astype(int) - picture[:, :640]).mean() < 20.0


def test_names_and_files_say_what_a_network_sees(folder: Path) -> None:
    named = {"dave2": "a+b", "a+b/n.yaml": "c", "mine:Class": "c"}
    for network, generators in [("dave2", ""), ("a+b/dave2.safetensors", ""), *named.items()]:
        text = f"{network}+{generators}" if generators else network
        assert DriverName.parse(text) == DriverName(network, generators) and str(DriverName.parse(text)) == text
    assert str(DriverName.parse("dave2@onnx").seeing("c")) == "dave2+c@onnx"
    assert str(DriverName.parse("dave2@onnx").seeing("")) == "dave2@onnx"
    assert str(received_driver(DriverName.parse("dave2+c@onnx"))) == "dave2+c@onnx"
    with pytest.raises(DriverError, match="Python code"):
        received_driver(DriverName.parse("mine:Class+c"))
    real = folder / "real.safetensors"
    assert architecture_in(real) == "dave2" and list(generators_in(str(real))) == list(WINDOWS)
    assert load_weights(str(real)).architecture is NETWORKS["dave2"]
    assert generators_in("dave2") == {} and NetworkDriver(f"{real}+none").translation is None


@pytest.fixture
def real(folder: Path) -> Path:
    """The network that was trained on translated images."""
    return folder / "real.safetensors"


def test_a_simulator_without_a_generator_is_noticed_before_anything_is_driven(real: Path) -> None:
    driver = DriverName(str(real))
    check_driver(driver, [BULLET])
    with pytest.raises(DriverError, match="no generator for images of donkey"):
        check_driver(driver, [BULLET, DONKEY])
    check_driver(driver.seeing("none"), [BULLET, DONKEY])


def test_a_node_that_its_user_starts_is_no_network() -> None:
    node = DriverName.parse("ros@torch")
    assert node.is_node and str(node) == "ros@torch"
    check_driver(node, [BULLET], attach=True)
    with pytest.raises(DriverError, match="a ROS node that you start"):
        check_driver(node, [BULLET])


def test_a_campaigns_key_is_part_of_its_drivers_name(real: Path) -> None:
    short = CampaignConfig(driver="dave2@onnx", sim2real="some/folder")  # type: ignore[arg-type]
    long, plain = CampaignConfig(driver=DriverName.parse("dave2+some/folder@onnx")), CampaignConfig()
    assert short == long and short.identity() != plain.identity()
    assert network_of(short.driver) == ("dave2", "real") == network_of(DriverName(str(real)))
    assert network_of(plain.driver) == ("dave2", "sim") == network_of(plain.driver.seeing("none"))
    for driver in ("autopilot", "dave2+other"):
        with pytest.raises(ValueError, match="leave sim2real out"):
            CampaignConfig(driver=driver, sim2real="some/folder")  # type: ignore[arg-type]


@pytest.mark.parametrize("driver", ["{0}", "{0}@onnx", "dave2+{1}", "{0}+none", "dave2_short+{1}@onnx"])
def test_another_machine_gets_the_generators_of_a_driver(real: Path, tmp_path: Path, driver: str) -> None:
    name = DriverName.parse(driver.format(real, real.parent / GENERATORS))
    parcel = parcel_of(name, [BULLET])
    parcel.unpack(tmp_path)
    there = parcel.driver_there(name, tmp_path)
    assert there != name and str(real.parent) not in str(there)
    assert driver_sha256(there) == driver_sha256(name) == parcel.driver_sha256
    backend = "openvino" if name.backend == "auto" else name.backend  # what auto is here
    assert there.backend == backend and (there.generators == "none") == (name.generators == "none")


def test_images_of_a_data_set_are_translated_unless_they_are_already(real: Path, tmp_path: Path) -> None:
    rng = np.random.default_rng(2)
    image = np.asarray(np.kron(rng.integers(0, 256, (20, 40, 3)), np.ones((8, 8, 1))), np.uint8)
    for folder in ("plain", "translated"):
        write_recorded(tmp_path / folder, "bullet", [image], [0.5])
    keep_import(tmp_path / "translated", "bullet", {"sim2real": "0"})
    found = {
        name: float(predict(tmp_path / name, DriverName(str(real)), SILENT)["bullet"].answered[0])
        for name in ("plain", "translated")
    }
    driver = NetworkDriver(str(real))
    seen = Frame(image=decode(jpeg(image)), speed=0.0, simulator=NOT_SIMULATED)
    plain = replace(seen, crop=Crop(54, 0), simulator="bullet")
    assert found["plain"] == pytest.approx(driver.command(plain).steering)
    assert found["translated"] == pytest.approx(driver.command(seen).steering)
    assert found["plain"] != found["translated"]
