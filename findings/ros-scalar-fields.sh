#!/usr/bin/env bash
# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
# ROS 2 Jazzy's wheels (ros-jazzy-rclpy 7.1.6, common-interfaces 5.3.6, rmw-fastrtps-cpp 8.4.3), NumPy 2.4.6,
# field checks off, as Jazzy has them. The number 1 as an int in float64 fields of one message: expected 1.0
# in all. Seen: sequences and arrays of fixed size convert ints, float32 and big-endian numbers; in a scalar
# field the bits of the int arrive, 5e-324.
set -euo pipefail
folder=$(mktemp -d); trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/venv"
"$folder/venv/bin/pip" --quiet --disable-pip-version-check install ros-jazzy-rclpy==7.1.6 \
	ros-jazzy-common-interfaces==5.3.6 ros-jazzy-rmw-fastrtps-cpp==8.4.3 numpy==2.4.6
env -u ROS_PYTHON_CHECK_FIELDS "$folder/venv/bin/python" - <<'PY'
import numpy as np
from rclpy.serialization import deserialize_message, serialize_message
from sensor_msgs.msg import Imu
from std_msgs.msg import Float64MultiArray


def arrived(message):
    return deserialize_message(serialize_message(message), type(message))


for ones in (np.ones(9, np.int64), np.ones(9, np.float32), np.ones(9, ">f8"), [1] * 9):
    assert list(arrived(Imu(orientation_covariance=ones)).orientation_covariance) == [1.0] * 9
    assert list(arrived(Float64MultiArray(data=ones)).data) == [1.0] * 9
imu = Imu()
imu.linear_acceleration.x = 1
imu.linear_acceleration.y = 1.0
imu.linear_acceleration.z = np.float64(1.0)
a = arrived(imu).linear_acceleration
print(a.x, a.y, a.z)
assert (a.x, a.y, a.z) == (5e-324, 1.0, 1.0)
PY
