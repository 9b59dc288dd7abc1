# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""The compiled path from a received message to the published answer."""
