"""``python -m maplines_can.cli``: the command ``maplines``."""

import sys

from . import main

sys.exit(main())
