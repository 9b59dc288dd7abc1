# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""The method on arrays: reduce, design, adapt. It knows neither ROS nor the loop."""
