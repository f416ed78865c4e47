"""``python -m magbridge.cli``."""

from __future__ import annotations

import sys

from magbridge.cli import main

if __name__ == "__main__":
    sys.exit(main())
