# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""As much of ROS's `launch_ros` as the launch files use; see `launch` beside it."""
