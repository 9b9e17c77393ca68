"""`python -m dvrk_drake.cli`, the same as `dvrk-drake`."""

import sys

from dvrk_drake.cli import main

sys.exit(main())
