"""Services to stop and arm a rig, and RViz: ros2 launch flexneedle_ros flexneedle.launch.py [rviz:=false]."""

from pathlib import Path

from ament_index_python.packages import get_package_share_directory
from launch import LaunchDescription
from launch.actions import DeclareLaunchArgument
from launch.conditions import IfCondition
from launch.substitutions import LaunchConfiguration
from launch_ros.actions import Node

PACKAGE = "flexneedle_ros"


def generate_launch_description():
    """Return the nodes: services and RViz."""
    config = Path(get_package_share_directory(PACKAGE)) / "config"
    operator = Node(
        package=PACKAGE,
        executable="operator",
        name="flexneedle_operator",
        parameters=[LaunchConfiguration("parameters")],
        output="screen",
    )
    rviz = Node(
        package="rviz2",
        executable="rviz2",
        arguments=["-d", str(config / "flexneedle.rviz")],
        condition=IfCondition(LaunchConfiguration("rviz")),
    )
    return LaunchDescription(
        [
            DeclareLaunchArgument("rviz", default_value="true", description="whether to start RViz"),
            DeclareLaunchArgument(
                "parameters", default_value=str(config / "operator.yaml"), description="file of parameters"
            ),
            operator,
            rviz,
        ]
    )
