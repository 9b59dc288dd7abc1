#!/usr/bin/env bash
# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
# ROS 2 Jazzy's wheels (ros-jazzy-rclpy 7.1.6, rmw-fastrtps-cpp 8.4.3), PyYAML 6.0.3. The number 0.00001 in a parameter
# file: expected a double for every reader. Seen: a node started with the file has it; `parameter_dict_from_yaml_file`
# of rclpy, by which parameters of running nodes are loaded, gives the string '1e-05', and a list with such a number
# is one string. 0.0001 and 0.000015 are doubles.
set -euo pipefail
folder=$(mktemp -d); trap 'rm -rf "$folder"' EXIT
python3 -m venv "$folder/venv"
"$folder/venv/bin/pip" --quiet --disable-pip-version-check install ros-jazzy-rclpy==7.1.6 \
	ros-jazzy-rmw-fastrtps-cpp==8.4.3 pyyaml==6.0.3 numpy==2.4.6
cd "$folder"
cat >gains.yaml <<'YAML'
/regulator:
  ros__parameters:
    large: 0.0001
    small: 0.00001
    odd: 0.000015
    both: [0.5, 0.00001]
YAML
ROS_AUTOMATIC_DISCOVERY_RANGE=LOCALHOST ROS_DOMAIN_ID=93 venv/bin/python - <<'PY'
import rclpy
from rclpy.parameter import parameter_dict_from_yaml_file, parameter_value_to_python

rclpy.init(args=["regulator", "--ros-args", "--params-file", "gains.yaml"])
node = rclpy.create_node("regulator", automatically_declare_parameters_from_overrides=True)
names = ("large", "small", "odd", "both")
started = {name: node.get_parameter(name).value for name in names}
started["both"] = list(started["both"])
node.destroy_node()
rclpy.shutdown()
loaded = parameter_dict_from_yaml_file("gains.yaml", target_nodes=["/regulator"])
loaded = {name: parameter_value_to_python(loaded[name].value) for name in names}
print(started, loaded, sep="\n")
assert started == {"large": 1e-4, "small": 1e-5, "odd": 1.5e-5, "both": [0.5, 1e-5]}
assert loaded == {"large": 1e-4, "small": "1e-05", "odd": 1.5e-5, "both": "[0.5, 1e-05]"}
PY
