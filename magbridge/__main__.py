"""The program: ``magbridge``, or ``python -m magbridge``."""

import sys

__all__ = ["main"]


def main(arguments: list[str] | None = None) -> int:
    """Run a command; return its exit code. Ctrl-C prints one line, even while libraries are being loaded."""
    try:
        from magbridge.cli import main as command  # noqa: PLC0415 - inside the try: importing takes time

        return command(arguments)
    except KeyboardInterrupt:
        print("magbridge: interrupted", file=sys.stderr)
        return 130


if __name__ == "__main__":
    sys.exit(main())
