# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""Figures and the HTML page of a run or a reproduction."""
