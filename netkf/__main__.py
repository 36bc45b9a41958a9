"""``python -m netkf`` is ``netkf``."""

import sys

from netkf.cli.main import main

sys.exit(main())
