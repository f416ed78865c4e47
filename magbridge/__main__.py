"""The program: ``magbridge``, or ``python -m magbridge``."""

import os
import sys

__all__ = ["main"]

LIVE = ("run", "replay", "correct")
"""Commands through which a sample takes the live path, and may be learned from."""


def main(arguments: list[str] | None = None) -> int:
    """Run a command; return its exit code. Ctrl-C prints one line, even while libraries are being loaded."""
    if (sys.argv[1:] if arguments is None else arguments)[:1] in [[name] for name in LIVE]:
        # read as numpy is loaded. Two threads round otherwise, which no replay on one core would repeat;
        # and on a busy computer they wait for each other for up to 0.4 s, where one alone takes 1 ms
        os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
    try:
        from magbridge.cli import main as command  # noqa: PLC0415 - inside the try: importing takes time

        return command(arguments)
    except KeyboardInterrupt:
        print("magbridge: interrupted", file=sys.stderr)
        return 130
    except OSError as error:  # a part of the program cannot be loaded: no file handle is left, a damaged disk
        print(f"magbridge: {error.strerror or error} (magbridge itself cannot be loaded)", file=sys.stderr)
        return 1


if __name__ == "__main__":
    sys.exit(main())
