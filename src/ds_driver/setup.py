import sys
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parents[2] / "tools"))
from package_setup import setup_package

setup_package(
    data=["models/*", "models/calibration/*", "models/sim2real/*/*"],
    scripts=[
        "driver = ds_driver.executables:driver",
        "autopilot = ds_driver.executables:autopilot",
        "closed_loop = ds_driver.executables:closed_loop",
        "camera_driver = ds_driver.executables:camera_driver",
        "cmd_vel_adapter = ds_driver.executables:cmd_vel_adapter",
    ],
)
