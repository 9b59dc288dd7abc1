# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""Recorded bags: reading, describing, verifying and playing them."""
