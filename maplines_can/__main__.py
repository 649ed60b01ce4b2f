"""``python -m maplines_can``: the command ``maplines``."""

import sys

from .cli import main

sys.exit(main())
