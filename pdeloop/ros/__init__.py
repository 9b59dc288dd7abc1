# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""ROS infrastructure of all nodes: event loop, endpoints, introspection, parameters."""
