"""A training: plants, controllers, the tuner and, if asked for, a recorder. Ends with the tuner.

ros2 launch pdeloop train.launch.py problem:=burgers record:=true pairs:=2
ros2 launch pdeloop train.launch.py --show-args
"""

from launch import LaunchDescription

from pdeloop.launch_actions import description
from pdeloop.launch_plan import TRAIN_ARGUMENTS, train_plan


def generate_launch_description() -> LaunchDescription:
    """Called by launch."""
    return description(TRAIN_ARGUMENTS, train_plan)
