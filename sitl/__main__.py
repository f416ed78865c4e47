"""Run ``python -m sitl``, which does the same as ``magbridge replay``."""

from __future__ import annotations

import sys

from magbridge.__main__ import main

if __name__ == "__main__":
    sys.exit(main(["replay", *sys.argv[1:]]))
