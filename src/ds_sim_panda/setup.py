import tomllib
from pathlib import Path

from setuptools import find_packages, setup

PROJECT = Path(__file__).resolve().parents[2] / "pyproject.toml"  # one version for all packages
PACKAGE = "ds_sim_panda"

setup(
    name=PACKAGE,
    version=tomllib.loads(PROJECT.read_text())["project"]["version"],
    description="Third digital sibling: a multi-body car in a world rendered by Panda3D.",
    license="Apache-2.0",
    maintainer="Digital Siblings maintainers",
    maintainer_email="maintainers@digital-siblings.invalid",
    packages=find_packages(exclude=["test"]),
    package_data={"": ["py.typed", "*.pyi"]},
    data_files=[
        ("share/ament_index/resource_index/packages", [f"resource/{PACKAGE}"]),
        (f"share/{PACKAGE}", ["package.xml"]),
    ],
    zip_safe=False,
    extras_require={"test": ["pytest"]},
    entry_points={"console_scripts": ["simulator = ds_sim_panda.main:main"]},
)
