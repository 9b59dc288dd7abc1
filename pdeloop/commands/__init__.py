# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""The commands of `pdeloop`, one module each: `add` declares the arguments, a handler does it."""
