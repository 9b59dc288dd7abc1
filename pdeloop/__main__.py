# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""`python -m pdeloop`: the command line."""

import os
import sys

if sys.path[0] == os.getcwd() and not sys.flags.safe_path:  # noqa: PTH109
    # Python put it there. What is installed comes first; `main` removes it (module_path.py).
    sys.path.append(sys.path.pop(0))

from pdeloop.cli import main

sys.exit(main())
