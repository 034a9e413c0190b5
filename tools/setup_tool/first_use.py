# SPDX-License-Identifier: Apache-2.0
"""Imports what a campaign's processes and its report import: these start together, and would all compile it.

Set-up starts this at its end, in the background and with the lowest priority: it takes a minute, and nothing waits.
"""

import importlib
from contextlib import suppress

MODULES = (
    *("ds_driver.ros.closed_loop_node", "ds_sim.ros.simulator_node", "ds_driver.ros.driver_node", "onnxruntime"),
    *("ds_sim_bullet.simulator", "ds_sim_panda.simulator", "ds_sim_softbody.simulator", "ds_twin_donkey.simulator"),
    *("ds_sim_ros.simulator", "ds_studies.whole_campaign", "ds_orchestrator.graph.client", "ds_report.heatmap"),
    *("ds_report.build", "sklearn.metrics", "plotly.graph_objects", "matplotlib.backends.backend_agg"),
)
CARS = (
    *(("ds_twin_donkey.simulator", "DonkeyVehicle"), ("ds_sim_softbody.simulator", "SoftbodyVehicle")),
    ("ds_sim_panda.simulator", "MultiBodyVehicle"),
)
"""Numba compiles them, which takes 2 s, 2 s and 10 s, and keeps the results beside their source."""

if __name__ == "__main__":
    for module, car in CARS:
        with suppress(ImportError):  # `ds doctor` names a library that cannot be imported
            vehicle = getattr(importlib.import_module(module), car)()
            if car == "SoftbodyVehicle":
                vehicle.reset(0.0, 0.0, 0.0, None)
    for module in MODULES:
        with suppress(ImportError):
            importlib.import_module(module)
