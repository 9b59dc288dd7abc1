# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""What the nodes share: topics, array codec, problem parameters, the nodes' event loop."""
