# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""The plant: equations, time stepping, and the node that publishes its state."""
