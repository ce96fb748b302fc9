"""What ``colcon build`` installs; ``ros2 run skyless_ros2 node`` starts the node."""

from setuptools import setup

setup(
    name="skyless_ros2",
    version="0.2.0",
    license="Apache-2.0",
    packages=["skyless_ros2"],
    data_files=[
        ("share/ament_index/resource_index/packages", ["resource/skyless_ros2"]),
        ("share/skyless_ros2", ["package.xml"]),
    ],
    entry_points={"console_scripts": ["node = skyless_ros2.node:main"]},
)
