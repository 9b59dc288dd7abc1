# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""Shows a running loop to ROS tools: markers, an image and named numbers, throttled."""
