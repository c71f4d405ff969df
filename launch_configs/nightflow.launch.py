"""Starts Nightflow with a configuration that lies beside this file, and starts it again when it falls.

ros2 launch launch_configs/nightflow.launch.py config:=px4_downward.toml
ros2 launch launch_configs/nightflow.launch.py config:=replay.toml bag:=flight.mcap
"""

from pathlib import Path

from launch import LaunchDescription
from launch.actions import DeclareLaunchArgument, ExecuteProcess, OpaqueFunction
from launch.substitutions import LaunchConfiguration

HERE = Path(__file__).resolve().parent
CONFIGS = [
    "px4_downward.toml",
    "ardupilot_downward.toml",
    "forward_avoidance.toml",
    "replay.toml",
    "ros2.toml",
    "zenoh.toml",
    "black_box.toml",
    "loop_through.toml",
]
ARGUMENTS = [
    DeclareLaunchArgument("config", default_value="px4_downward.toml", choices=CONFIGS),
    DeclareLaunchArgument("bag", default_value="", description="a recording to replay in place of the camera"),
    DeclareLaunchArgument("program", default_value="nightflow", description="where the program lies"),
]


def start(context):
    config, bag, program = (LaunchConfiguration(name).perform(context) for name in ("config", "bag", "program"))
    command = [program, "run", "--config", str(HERE / config)]
    if bag:
        command = [program, "replay", bag, "--realtime", "--config", str(HERE / config)]
    # A live node has no end of its own; a replay has.
    return [ExecuteProcess(cmd=command, name="nightflow", output="screen", respawn=not bag, respawn_delay=1.0)]


def generate_launch_description():
    return LaunchDescription([*ARGUMENTS, OpaqueFunction(function=start)])
