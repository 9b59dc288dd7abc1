# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""Design: the first law, from a model."""
