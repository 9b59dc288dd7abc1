# Copyright the pdeloop developers. SPDX-License-Identifier: Apache-2.0
"""`python -m pdeloop`: the command line."""

import sys

from pdeloop.cli import main

sys.exit(main())
