# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""Plants on which nobody chose the constants of the method: `python -m benchmarks general`.

`equations` has PDEs of the compiled solver's form, `plants` others, `cases` says what is varied.
"""
