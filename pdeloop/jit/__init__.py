# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""Compiled helpers: vector lanes, atomic words, calls by address, the cache."""
