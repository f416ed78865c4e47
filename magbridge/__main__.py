"""Start the program, as ``magbridge`` or ``python -m magbridge``."""

import gc
import os
import sys
from io import TextIOWrapper
from pathlib import Path

__all__ = ["main"]

LIVE = ("run", "replay", "correct")
"""Commands that process samples as the live bridge does, possibly with online calibration."""


def main(arguments: list[str] | None = None) -> int:
    """Run a command and return its exit code; Ctrl-C prints one line, even while libraries are loaded."""
    given = sys.argv[1:] if arguments is None else arguments
    _open_streams()
    if given[:1] in [[name] for name in LIVE]:
        # numpy reads this when it is loaded. Results of two threads differ in rounding, so a replay on one
        # core would not repeat them. On a busy computer, threads also wait up to 0.4 s for each other.
        os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
    try:
        if len(given) == 3 and given[:2] == ["run", "--config"] and not given[2].startswith("-"):
            return _run_bridge(Path(given[2]))
        from magbridge.cli import main as command  # noqa: PLC0415 - inside the try: importing takes time

        return command(arguments)
    except KeyboardInterrupt:
        print("magbridge: interrupted", file=sys.stderr)
        return 130
    except OSError as error:  # a module cannot be loaded: no file handle is left, or a damaged disk
        print(f"magbridge: {error.strerror or error} (magbridge itself cannot be loaded)", file=sys.stderr)
        return 1


def _run_bridge(config: Path) -> int:
    """Run a bridge without loading the command line, which would delay its first heartbeat."""
    gc.disable()  # until the bridge runs: loaded modules stay, so the collector would only scan them
    from magbridge.bridge.run import run  # noqa: PLC0415 - as above
    from magbridge.errors import MagbridgeError  # noqa: PLC0415

    try:
        run(config)
    except (MagbridgeError, ImportError, UnicodeEncodeError, OSError, MemoryError) as error:
        from magbridge.cli import report_error  # noqa: PLC0415 - only now

        return report_error(error)
    return 0


def _open_streams() -> None:
    """Open missing standard streams, and make every character printable in any locale."""
    # closed by the parent process; opened in this order, each gets its own descriptor
    for name, mode in (("stdin", "r"), ("stdout", "w"), ("stderr", "w")):
        if getattr(sys, name) is None:
            setattr(sys, name, Path(os.devnull).open(mode))  # noqa: SIM115 - as long as the process
    out = sys.stdout
    if isinstance(out, TextIOWrapper) and (out.errors == "strict" or out.encoding.lower() != "utf-8"):
        # as stderr does, also in the locale C: a result must not end in an error
        out.reconfigure(errors="backslashreplace")


if __name__ == "__main__":
    sys.exit(main())
