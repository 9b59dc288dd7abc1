# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""The controller: reduced model, LQ tracking, projected law, and the node that answers states."""
