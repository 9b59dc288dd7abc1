# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""The published tasks: one module each, whose `rows` measures its table."""
