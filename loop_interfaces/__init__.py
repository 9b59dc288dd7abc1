# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""Interfaces that all nodes share: topics, array codec, problem parameters, the nodes' event loop."""
