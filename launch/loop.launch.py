"""Plants and controllers of a problem, in a namespace: they serve whichever tuner comes.

ros2 launch pdeloop loop.launch.py problem:=kdv namespace:=lab
ros2 launch pdeloop loop.launch.py --show-args
"""

from launch import LaunchDescription

from pdeloop.launch_actions import description
from pdeloop.launch_plan import LOOP_ARGUMENTS, loop_plan


def generate_launch_description() -> LaunchDescription:
    """Called by launch."""
    return description(LOOP_ARGUMENTS, loop_plan)
