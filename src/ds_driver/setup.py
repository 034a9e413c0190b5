import tomllib
from pathlib import Path

from setuptools import find_packages, setup

PROJECT = Path(__file__).resolve().parents[2] / "pyproject.toml"  # one version for all packages
PACKAGE = "ds_driver"

setup(
    name=PACKAGE,
    version=tomllib.loads(PROJECT.read_text())["project"]["version"],
    description="Driving networks, their training, and the nodes that drive.",
    license="Apache-2.0",
    maintainer="Digital Siblings maintainers",
    maintainer_email="maintainers@digital-siblings.invalid",
    packages=find_packages(exclude=["test"]),
    package_data={"": ["py.typed", "*.pyi"], PACKAGE: ["models/*", "models/sim2real/*/*"]},
    data_files=[
        ("share/ament_index/resource_index/packages", [f"resource/{PACKAGE}"]),
        (f"share/{PACKAGE}", ["package.xml"]),
    ],
    zip_safe=False,
    extras_require={"test": ["pytest"]},
    entry_points={
        "console_scripts": [
            "driver = ds_driver.executables:driver",
            "autopilot = ds_driver.executables:autopilot",
            "closed_loop = ds_driver.executables:closed_loop",
            "camera_driver = ds_driver.executables:camera_driver",
            "cmd_vel_adapter = ds_driver.executables:cmd_vel_adapter",
        ],
    },
)
