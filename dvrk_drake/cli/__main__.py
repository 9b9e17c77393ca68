"""Entry point of `python -m dvrk_drake.cli`, which is equivalent to `dvrk-drake`."""

import sys

from dvrk_drake.cli import main

sys.exit(main())
