"""Start the node of ftdrive: `ros2 launch ./ftdrive_launch.py calibration:=runs/gripper`."""

from pathlib import Path

from launch import LaunchDescription
from launch.actions import DeclareLaunchArgument, ExecuteProcess
from launch.substitutions import LaunchConfiguration

HERE = Path(__file__).parent


def generate_launch_description() -> LaunchDescription:
    """Return the node, which is restarted if it ends by itself."""
    defaults = {
        "calibration": "runs/gripper",
        "config": "ftdrive.toml",
        "namespace": "/",
        "params": str(HERE / "ftdrive.yaml"),
    }
    arguments = [DeclareLaunchArgument(name, default_value=value) for name, value in defaults.items()]
    given = {name: LaunchConfiguration(name) for name in defaults}
    command = ["ftdrive", "ros2", "--calibration", given["calibration"], "--config", given["config"]]
    command += ["--ros-args", "-r", ["__ns:=", given["namespace"]], "--params-file", given["params"]]
    node = ExecuteProcess(cmd=command, output="screen", respawn=True, respawn_delay=2.0)
    return LaunchDescription([*arguments, node])
