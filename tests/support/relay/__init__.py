# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""A relay that loses, repeats, delays and reorders messages on purpose."""
