# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""The web outlet of the view core: a page and its server, on this machine only."""
