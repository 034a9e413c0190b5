# SPDX-License-Identifier: Apache-2.0
"""Hybrids of simulators: one of a simulator's own parts is that simulator, and each exchanged part is the other's."""

from __future__ import annotations

import numpy as np
import pytest

from ds_sim.hybrid import PARTS, HybridError, HybridSimulator, differing_parts, exchangeable, hybrid_name
from ds_sim.registry import make_simulator
from ds_sim.simulator import Simulator
from ds_sim.testing import WINDING, drive, reference_driver, run_check

STEPS = 6


def seen(simulator: Simulator, steps: int = STEPS) -> list[bytes]:
    """Everything that a driver and a test see, as bytes."""
    frames = drive(simulator, WINDING, reference_driver(simulator.spec.autopilot), steps=steps)
    simulator.close()
    return [f.image.tobytes() + repr((f.step, f.vehicle, f.lane, f.outcome)).encode() for f in frames]


def test_a_hybrid_of_own_parts_is_the_simulator_byte_for_byte(simulator_name: str) -> None:
    hybrid = make_simulator(hybrid_name(dict.fromkeys(PARTS, simulator_name)))
    assert hybrid.spec == make_simulator(simulator_name).spec
    assert seen(hybrid) == seen(make_simulator(simulator_name))


def test_an_exchanged_part_is_that_of_the_other_simulator() -> None:
    names = {"camera": "donkey", "look": "bullet", "vehicle": "softbody", "delays": "bullet"}
    hybrid = HybridSimulator(names)
    donkey, bullet, softbody = (make_simulator(name).spec for name in ("donkey", "bullet", "softbody"))
    camera = hybrid.spec.camera
    assert (camera.lens, camera.height, hybrid.spec.crop_top) == ("equidistant", donkey.camera.height, donkey.crop_top)
    assert (camera.noise, camera.exposure, camera.latency) == (bullet.camera.noise, 0.0, 0)
    assert hybrid.spec.look == bullet.look and hybrid.spec.wheelbase == softbody.wheelbase
    own = drive(make_simulator("softbody"), WINDING, reference_driver(softbody.autopilot), steps=STEPS)
    assert [f.vehicle for f in drive(hybrid, WINDING, reference_driver(softbody.autopilot), steps=STEPS)] == [
        f.vehicle for f in own
    ]


def test_delays_move_with_their_part() -> None:
    """The dead time of the twin's commands, 42 ms, on a car without one, and a twin without it; and its late image."""
    names = dict.fromkeys(PARTS, "bullet")
    late, prompt = HybridSimulator({**names, "delays": "donkey"}), HybridSimulator(names)
    driver = reference_driver(prompt.spec.autopilot)
    behind = [f.vehicle.speed for f in drive(late, WINDING, driver, steps=4)]
    ahead = [f.vehicle.speed for f in drive(prompt, WINDING, driver, steps=4)]
    assert behind[1] < 0.5 * ahead[1]
    assert np.array_equal(late.load(WINDING, seed=3).image, late.step(driver(late.load(WINDING, seed=3))).image)
    twin = HybridSimulator({**dict.fromkeys(PARTS, "donkey"), "delays": "bullet"})
    own = make_simulator("donkey")
    driver = reference_driver(own.spec.autopilot)
    twin_speed, own_speed = (drive(one, WINDING, driver, steps=4)[2].vehicle.speed for one in (twin, own))
    assert twin_speed > own_speed and twin.spec.camera.latency == 0


@pytest.mark.parametrize("check", ["same_bits_again", "drawn_rows_are_the_same"])
def test_a_hybrid_keeps_the_contract(check: str) -> None:
    name = hybrid_name({"camera": "donkey", "look": "softbody", "vehicle": "bullet", "delays": "donkey"})
    run_check(check, str(name))


def test_what_cannot_be_exchanged_is_said_in_one_line() -> None:
    with pytest.raises(HybridError, match="draws its scene as a whole"):
        HybridSimulator({**dict.fromkeys(PARTS, "bullet"), "look": "panda"})
    with pytest.raises(HybridError, match="expected camera, look, vehicle, delays"):
        make_simulator("ds_sim.hybrid:HybridSimulator@camera=bullet")
    with pytest.raises(HybridError, match="comma"):
        hybrid_name(dict.fromkeys(PARTS, "donkey@a,b.yaml"))
    bullet, softbody = exchangeable("bullet"), exchangeable("softbody")
    assert differing_parts(bullet, exchangeable("panda")) == [("camera", "look"), ("vehicle",)]
    assert differing_parts(bullet, softbody) == [("camera",), ("look",), ("vehicle",)]
