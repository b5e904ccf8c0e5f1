"""The package flexneedle_ros, built by colcon."""

from setuptools import setup

PACKAGE = "flexneedle_ros"

setup(
    name=PACKAGE,
    version="0.1.0",
    packages=[PACKAGE],
    data_files=[
        ("share/ament_index/resource_index/packages", [f"resource/{PACKAGE}"]),
        (f"share/{PACKAGE}", ["package.xml"]),
        (f"share/{PACKAGE}/launch", ["launch/flexneedle.launch.py"]),
        (f"share/{PACKAGE}/config", ["config/operator.yaml", "config/flexneedle.rviz"]),
    ],
    install_requires=["setuptools"],
    zip_safe=True,
    license="Apache-2.0",
    description="Services to stop and arm a flexneedle rig, a launch file and an RViz configuration for its topics.",
    entry_points={"console_scripts": [f"operator = {PACKAGE}.operator:main"]},
)
