# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""Plants that were not used to choose the method's constants: `python -m benchmarks general`.

`equations` has PDEs of the compiled solver's form, `plants` others, `cases` says what is varied.
"""
