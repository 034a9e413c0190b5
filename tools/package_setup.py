"""Set-up that all Python packages of the workspace share; each `setup.py` names only what is its own."""

from __future__ import annotations

import xml.etree.ElementTree as ElementTree
from collections.abc import Sequence
from pathlib import Path

from setuptools import find_packages, setup


def setup_package(*, scripts: Sequence[str] = (), data: Sequence[str] = ()) -> None:
    """Set up the package in the working directory, which is where colcon runs `setup.py`.

    Args:
        scripts: executables for `ros2 run`, as `name = module:function`.
        data: patterns of further files to install, relative to any folder of modules.
    """
    manifest = ElementTree.parse("package.xml").getroot()
    name = str(manifest.findtext("name"))
    maintainer = manifest.find("maintainer")
    assert maintainer is not None
    setup(
        name=name,
        version=manifest.findtext("version"),
        description=manifest.findtext("description"),
        license=manifest.findtext("license"),
        maintainer=maintainer.text,
        maintainer_email=maintainer.get("email"),
        packages=find_packages(exclude=["test"]),
        package_data={"": ["py.typed", "*.pyi", *data]},
        data_files=[
            ("share/ament_index/resource_index/packages", [str(Path("resource", name))]),
            (f"share/{name}", ["package.xml"]),
        ],
        zip_safe=False,
        extras_require={"test": ["pytest"]},  # what colcon looks for to run pytest
        entry_points={"console_scripts": list(scripts)},
    )
