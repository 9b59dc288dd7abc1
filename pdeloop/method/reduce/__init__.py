# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""Reduce: a linear model of low order, identified from exploratory trajectories."""
