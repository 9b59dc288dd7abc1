# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""What nodes, method and tools share: topics, array codec, parameters, files. No ROS."""
