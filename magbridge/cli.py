"""The command line: one thin function a command; the help is its docstring.

Exit codes: 0 done, 1 the data do not allow it, 2 wrong use. What is wrong goes to stderr as one line.
"""

from __future__ import annotations

import sys
from pathlib import Path

from cyclopts import App, CycloptsError

from magbridge import __version__
from magbridge.errors import MagbridgeError

__all__ = ["app", "main"]

app = App(
    name="magbridge",
    help="A magnetometer bridge for vehicles whose own iron moves.",
    version=__version__,
    help_format="plaintext",
)


@app.command
def run(*, config: Path) -> None:
    """Attach to the sensor and the autopilot link, and publish the corrected field until stopped.

    Parameters
    ----------
    config
        The bridge.toml.
    """
    from magbridge.bridge.live import run as live

    live(config)


def main(arguments: list[str] | None = None) -> int:
    """Run a command; return its exit code."""
    try:
        app(arguments, exit_on_error=False, print_error=False, result_action="return_value")
    except CycloptsError as error:
        return complain(str(error), 2)
    except MagbridgeError as error:
        return complain(str(error), error.exit_code)
    except BrokenPipeError:  # the reader of our output has gone, as `| head` does
        sys.stderr.close()
        return 0
    return 0


def complain(sentence: str, code: int) -> int:
    """Print one line to stderr and return `code`."""
    print("magbridge:", " ".join(sentence.split()), file=sys.stderr)
    return code


if __name__ == "__main__":
    sys.exit(main())
