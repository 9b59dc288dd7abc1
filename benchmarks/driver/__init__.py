# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""Stands in for the tuner in measurements: episodes on demand, timed."""
