"""`python -m pdeloop`: the command line."""

import sys

from pdeloop.cli import main

sys.exit(main())
