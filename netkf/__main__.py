"""``python -m netkf`` is ``netkf``."""

import sys

from netkf.cli import main

sys.exit(main())
