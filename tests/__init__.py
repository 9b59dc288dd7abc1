# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""The tests. Messages check the types of their fields, as in many people's shells (read on import)."""

import os

os.environ["ROS_PYTHON_CHECK_FIELDS"] = "1"
