# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""Whether a stand-in keeps to the interface: `checks` (pure), and `node`, which reaches it."""
