"""``python -m maplines_can.cli``."""

import sys

from . import main

sys.exit(main())
