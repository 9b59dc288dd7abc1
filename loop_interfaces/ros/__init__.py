# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""What the nodes share of ROS: event loop, endpoints, introspection, parameters."""
