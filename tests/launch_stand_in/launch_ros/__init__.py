"""As much of ROS's `launch_ros` as the launch files use; see `launch` beside it."""
