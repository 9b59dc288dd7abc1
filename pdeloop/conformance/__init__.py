# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""Tests of a stand-in against the protocol: `checks` (pure), and `node`, which reaches it."""
