# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""A process of the loop: its start, module path and cores, and who receives its messages."""
