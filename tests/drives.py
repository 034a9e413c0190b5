# SPDX-License-Identifier: Apache-2.0
"""Drives of one road by the library, with which tests compare those of others."""

from __future__ import annotations

from contextlib import closing

from ds_driver.closed_loop.simulation import drive_road, make_driver
from ds_driver.networks.driver_name import AUTOPILOT, DriverName
from ds_road import Road
from ds_sim.conditions.model import DEFAULT, Conditions
from ds_sim.registry import make_simulator
from ds_sim.session import RunRecord


def driven(
    simulator: str,
    road: Road,
    seed: int = 1,
    conditions: Conditions = DEFAULT,
    *,
    driver: DriverName = AUTOPILOT,
    probed: bool = False,
) -> RunRecord:
    """Drive a road on a simulator of its own."""
    with closing(make_simulator(simulator)) as made:
        return drive_road(made, make_driver(driver, made.spec), road, seed, conditions, probed=probed)
