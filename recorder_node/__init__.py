# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""The recorder: real rosbag2 bags of the loop's topics, with an index of the episodes in them."""
