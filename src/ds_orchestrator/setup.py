import sys
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parents[2] / "tools"))
from package_setup import setup_package

# `ros2 run ds_orchestrator campaign` is a verb of the command line, which lies above this package.
setup_package(
    scripts=[
        "campaign = ds_cli.ros.executables:campaign",
        "drive = ds_cli.ros.executables:drive",
        "orchestrator = ds_cli.ros.executables:orchestrator",
        "watch = ds_cli.ros.executables:watch",
    ],
)
