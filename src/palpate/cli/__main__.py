"""``python -m palpate.cli`` is the command ``palpate``."""

from __future__ import annotations

import sys

from . import main

sys.exit(main())
