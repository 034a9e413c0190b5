import tomllib
from pathlib import Path

from setuptools import find_packages, setup

PROJECT = Path(__file__).resolve().parents[2] / "pyproject.toml"  # one version for all packages
PACKAGE = "ds_orchestrator"

setup(
    name=PACKAGE,
    version=tomllib.loads(PROJECT.read_text())["project"]["version"],
    description="Search, campaign, store, bags, feature maps, evaluation, report and command line.",
    license="Apache-2.0",
    maintainer="Digital Siblings maintainers",
    maintainer_email="maintainers@digital-siblings.invalid",
    packages=find_packages(exclude=["test"]),
    package_data={"": ["py.typed", "*.pyi"], f"{PACKAGE}.report": ["templates/*"], f"{PACKAGE}.watch": ["templates/*"]},
    data_files=[
        ("share/ament_index/resource_index/packages", [f"resource/{PACKAGE}"]),
        (f"share/{PACKAGE}", ["package.xml"]),
    ],
    zip_safe=False,
    extras_require={"test": ["pytest"]},
    entry_points={
        "console_scripts": [
            "ds = ds_orchestrator.cli.main:main",
            "campaign = ds_orchestrator.ros.executables:campaign",
            "drive = ds_orchestrator.ros.executables:drive",
            "demo = ds_orchestrator.ros.executables:demo",
            "watch = ds_orchestrator.ros.executables:watch",
        ],
    },
)
