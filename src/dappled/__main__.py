"""`python -m dappled`."""

import sys

from dappled.cli import main

sys.exit(main())
