# SPDX-License-Identifier: Apache-2.0
"""A simulator and its driver in one process: what happens to the run, and to the next one, when the driver fails."""

from __future__ import annotations

import os
import threading
from collections.abc import Iterator
from contextlib import closing
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from sensor_msgs.msg import Image
from std_srvs.srv import Trigger
from tests.drives import driven
from tests.graph.processes import SHORT, SPACE, watched_run
from tests.waiting import wait_until

from ds_driver.networks.driver_name import DriverName
from ds_driver.sim2real.generator import GeneratorShape, Window, load_generator, save_generator
from ds_driver.sim2real.image_translation import Translator
from ds_driver.sim2real.networks import Generator
from ds_orchestrator.campaign.executor import trajectory_sha256
from ds_orchestrator.graph.session import running_graph
from ds_sim.registry import DONKEY, make_simulator, spec_of
from ds_sim.ros.conversions import pixels_of
from ds_sim.scenario import Scenario
from ds_sim.simulator import Outcome, Reason

pytestmark = pytest.mark.graph

LIMIT = 3.0
"""Command timeout of the simulator, s."""
BUSY = 60.0
"""What a run and its services may take on a busy machine, in addition to the timeouts, s."""
DRIVER = """
import os, pathlib, time

class Ordered:
    def drive(self, seen):
        order = pathlib.Path(__file__).with_name("order")
        if seen.step == 20 and order.exists():
            what = order.read_text()
            order.unlink()
            if what == "crash":
                os._exit(3)
            time.sleep(3600.0)
        return 0.0
"""


@pytest.fixture(scope="module")
def ordered(tmp_path_factory: pytest.TempPathFactory) -> Iterator[tuple[Any, Path]]:
    """A donkey with a driver that hangs or crashes when the file exists, once; yields (executor, file)."""
    folder = tmp_path_factory.mktemp("ordered")
    (folder / "ordered_driver.py").write_text(DRIVER)
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("PYTHONPATH", f"{folder}{os.pathsep}{os.environ.get('PYTHONPATH', '')}")
        driver = DriverName("ordered_driver:Ordered")
        with running_graph(SPACE, driver, command_timeout=LIMIT, logs=folder / "logs") as executor:
            yield executor, folder / "order"


def test_rows_that_nobody_sees_are_left_out_and_the_run_is_the_same(tmp_path: Path) -> None:
    """A subscriber that is there before a run gets whole images; without one, the crop is drawn."""
    driver, top = DriverName("dave2_short"), spec_of("donkey").crop_top
    here = driven("donkey", SHORT, driver=driver)
    with running_graph(SPACE, driver, command_timeout=10.0, logs=tmp_path, draw="seen") as executor:
        # One that comes while a run is under way takes part in the next one.
        unseen = executor.execute(DONKEY, Scenario(SHORT, seed=1))
        topics = {"/ds1/camera/image_raw": Image}
        seen, heard = watched_run(executor, DONKEY, Scenario(SHORT, seed=1), "/ds1/simulator", topics)
    (images,) = heard.values()
    assert trajectory_sha256(unseen) == trajectory_sha256(seen) == trajectory_sha256(here)
    assert top > 0 and all(np.any(pixels_of(image)[:top]) for image in images)


def test_both_nodes_have_their_names_and_topics(ordered: tuple[Any, Path]) -> None:
    executor, _ = ordered
    node = executor._node
    assert {"simulator", "driver"} <= {name for name, space in node.get_node_names_and_namespaces() if space == "/ds1"}
    (publisher,) = node.get_publishers_info_by_topic("/ds1/drive")
    (subscriber,) = node.get_subscriptions_info_by_topic("/ds1/frame")
    assert publisher.node_name == subscriber.node_name == "driver"


def test_a_hanging_driver_stops_neither_reset_nor_watchdog_and_is_replaced(ordered: tuple[Any, Path]) -> None:
    executor, order = ordered
    order.write_text("hang")
    runs: list[Any] = []
    drive = threading.Thread(target=lambda: runs.append(executor.execute("donkey", Scenario(SHORT, seed=1))))
    drive.start()
    wait_until(lambda: not order.exists())
    assert executor._thread.ask(executor._simulators["donkey"].reset, Trigger.Request(), BUSY).success
    drive.join(LIMIT + BUSY)
    assert (runs[0].outcome, runs[0].reason, runs[0].steps) == (Outcome.CANCELLED, Reason.RESET, 20)
    silent = executor.execute("donkey", Scenario(SHORT, seed=1))  # it still hangs
    assert silent.outcome is Outcome.DRIVER_SILENT and silent.steps == 0
    assert executor.execute("donkey", Scenario(SHORT, seed=1)).outcome is Outcome.COMPLETED


def test_a_crashing_driver_takes_its_simulator_along_and_both_come_back(ordered: tuple[Any, Path]) -> None:
    executor, order = ordered
    order.write_text("crash")
    run = executor.execute("donkey", Scenario(SHORT, seed=1))
    assert run.outcome is Outcome.SIM_ERROR and "closed_loop_ds1 ended during the run" in run.message
    # At which it crashes, or the one before.
    assert "after frame 20 " in run.message or "after frame 10 " in run.message
    assert executor.execute("donkey", Scenario(SHORT, seed=1)).outcome is Outcome.COMPLETED


def test_a_node_drives_with_the_bits_of_this_process_and_publishes_what_it_sees(tmp_path: Path) -> None:
    shape, window = GeneratorShape(filters=2, blocks=1, rows=32, columns=64), Window(60, 160, 0, 320)
    torch.manual_seed(1)
    tensors = {name: value.numpy() for name, value in Generator(shape).state_dict().items()}
    path = tmp_path / "set" / "donkey.safetensors"
    path.parent.mkdir()
    save_generator(path, tensors, simulator="donkey", shape=shape, window=window, real_window=window)
    driver = DriverName("dave2_short", str(path.parent))
    here = driven("donkey", SHORT, driver=driver)
    with closing(make_simulator("donkey")) as simulator:
        first = simulator.load(SHORT, seed=1).image
    with running_graph(SPACE, driver, command_timeout=10.0, logs=tmp_path, draw="seen") as executor:
        topics = {"/ds1/sim2real/image_raw": Image}
        there, heard = watched_run(executor, DONKEY, Scenario(SHORT, seed=1), "/ds1/driver", topics, last=0)
    (images,) = heard.values()
    assert trajectory_sha256(there) == trajectory_sha256(here) and len(here.commands) > 20
    assert np.array_equal(pixels_of(images[0]), Translator(load_generator(path)).translate(first))
