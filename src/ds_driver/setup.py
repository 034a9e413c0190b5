from setuptools import find_packages, setup

PACKAGE = "ds_driver"

setup(
    name=PACKAGE,
    version="0.1.0",
    description="Driving networks, their training, and the nodes that drive.",
    license="Apache-2.0",
    maintainer="Digital Siblings maintainers",
    maintainer_email="maintainers@digital-siblings.invalid",
    packages=find_packages(exclude=["test"]),
    package_data={"": ["py.typed", "*.pyi"], PACKAGE: ["models/*"]},
    data_files=[
        ("share/ament_index/resource_index/packages", [f"resource/{PACKAGE}"]),
        (f"share/{PACKAGE}", ["package.xml"]),
    ],
    zip_safe=False,
    entry_points={
        "console_scripts": [
            "driver = ds_driver.executables:driver",
            "autopilot = ds_driver.executables:autopilot",
            "camera_driver = ds_driver.executables:camera_driver",
            "cmd_vel_adapter = ds_driver.executables:cmd_vel_adapter",
        ],
    },
)
