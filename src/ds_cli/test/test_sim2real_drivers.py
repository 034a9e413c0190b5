# SPDX-License-Identifier: Apache-2.0
"""Drivers that see translated images, in campaigns and elsewhere: checked at the start, and sent to other machines."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from made_networks import write_generator, write_recorded

from ds_analysis.paper.open_loop import predict
from ds_analysis.paper.paper_tables import network_of
from ds_base.progress import SILENT
from ds_driver.data.dataset import decode, keep_import
from ds_driver.networks.driver_name import DriverName
from ds_driver.networks.images import Crop
from ds_driver.networks.network_driver import NetworkDriver, driver_sha256
from ds_driver.networks.pilot import NOT_SIMULATED, DriverError, Frame
from ds_driver.networks.torch_networks import make_network, save_weights
from ds_orchestrator.campaign.config import CampaignConfig
from ds_orchestrator.engines.dask_worker import parcel_of
from ds_orchestrator.engines.start import check_driver
from ds_sim import BULLET, DONKEY
from ds_sim.camera.encodings import jpeg


@pytest.fixture(scope="module")
def weights(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A network that was trained on translated images of bullet, and its generator beside it."""
    folder = tmp_path_factory.mktemp("network")
    digests = {"bullet": write_generator(folder / "sim2real" / "bullet.safetensors").sha256}
    save_weights(make_network("dave2"), folder / "net.safetensors", architecture="dave2", generators=digests)
    return folder / "net.safetensors"


def test_a_simulator_without_a_generator_is_noticed_before_anything_is_driven(weights: Path) -> None:
    driver = DriverName(str(weights))
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


def test_a_campaigns_key_is_part_of_its_drivers_name(weights: Path) -> None:
    short = CampaignConfig(driver="dave2@onnx", sim2real="some/folder")  # type: ignore[arg-type]
    long, plain = CampaignConfig(driver=DriverName.parse("dave2+some/folder@onnx")), CampaignConfig()
    assert short == long and short.identity() != plain.identity()
    assert network_of(short.driver) == ("dave2", "real") == network_of(DriverName(str(weights)))
    assert network_of(plain.driver) == ("dave2", "sim") == network_of(plain.driver.seeing("none"))
    for driver in ("autopilot", "dave2+other"):
        with pytest.raises(ValueError, match="leave sim2real out"):
            CampaignConfig(driver=driver, sim2real="some/folder")  # type: ignore[arg-type]


@pytest.mark.parametrize("driver", ["{0}", "{0}@onnx", "dave2+{1}", "{0}+none", "dave2_short+{1}@onnx"])
def test_another_machine_gets_the_generators_of_a_driver(weights: Path, tmp_path: Path, driver: str) -> None:
    name = DriverName.parse(driver.format(weights, weights.parent / "sim2real"))
    parcel = parcel_of(name, [BULLET])
    parcel.unpack(tmp_path)
    there = parcel.driver_there(name, tmp_path)
    assert there != name and str(weights.parent) not in str(there)
    assert driver_sha256(there) == driver_sha256(name) == parcel.driver_sha256
    backend = "openvino" if name.backend == "auto" else name.backend  # what auto is here
    assert there.backend == backend and (there.generators == "none") == (name.generators == "none")


def test_images_of_a_data_set_are_translated_unless_they_are_already(weights: Path, tmp_path: Path) -> None:
    rng = np.random.default_rng(2)
    image = np.asarray(np.kron(rng.integers(0, 256, (20, 40, 3)), np.ones((8, 8, 1))), np.uint8)
    for folder in ("plain", "translated"):
        write_recorded(tmp_path / folder, "bullet", [image], [0.5])
    keep_import(tmp_path / "translated", "bullet", {"sim2real": "0"})
    found = {
        name: float(predict(tmp_path / name, DriverName(str(weights)), SILENT)["bullet"].answered[0])
        for name in ("plain", "translated")
    }
    driver = NetworkDriver(str(weights))
    seen = Frame(image=decode(jpeg(image)), speed=0.0, simulator=NOT_SIMULATED)
    plain = replace(seen, crop=Crop(54, 0), simulator="bullet")
    assert found["plain"] == pytest.approx(driver.command(plain).steering)
    assert found["translated"] == pytest.approx(driver.command(seen).steering)
    assert found["plain"] != found["translated"]
