# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""Measuring programs: `python -m benchmarks`."""
