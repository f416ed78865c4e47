"""What the studies run on: dask.distributed, as ``magbridge fleet process`` does, here or on a cluster.

The workers of a scheduler need this checkout at the same place, and its environment.
"""

from __future__ import annotations

import argparse
import importlib
import sys
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

try:
    from distributed import Future, as_completed
    from rich.console import Console
    from rich.progress import track

    from magbridge.fleet.process import client_of
except ImportError as error:
    sys.exit(f"{error.name} is not installed: pip install '.[fleet]', or python3 tools/dev.py check")

__all__ = ["add_engine", "as_done", "in_order"]

EVERY = 10
"""Cases after which a study says how far it is, where there is no terminal."""


def add_engine(parser: argparse.ArgumentParser) -> None:
    """Add the options that say where a study runs."""
    parser.add_argument("--workers", type=int, default=2, help="processes on this machine")
    parser.add_argument("--scheduler", default="", help="address of a dask scheduler to use instead")
    parser.add_argument("--wait-for", type=int, default=1, help="workers that must be there before it starts")


def as_done(
    function: Callable[..., Any], cases: Sequence[Any], options: argparse.Namespace
) -> Iterator[tuple[Any, Future[Any]]]:
    """Run a tool's function on cases, each the tuple of its arguments; yield each as it is done."""
    for number, future in _numbered(function, cases, options):
        yield cases[number], future


def in_order(function: Callable[..., Any], cases: Sequence[Any], options: argparse.Namespace) -> list[Any]:
    """Run a tool's function on cases; return their results in the order of the cases."""
    done = {number: future.result() for number, future in _numbered(function, cases, options)}
    return [done[number] for number in range(len(cases))]


def _numbered(
    function: Callable[..., Any], cases: Sequence[Any], options: argparse.Namespace
) -> Iterator[tuple[int, Future[Any]]]:
    """Yield the number of each case as it is done."""
    if not cases:
        return
    progress = Console(stderr=True)
    module = function.__module__
    if module == "__main__":
        module = Path(function.__code__.co_filename).stem
    with client_of(options.scheduler, options.workers, "auto") as client:
        client.wait_for_workers(options.wait_for, timeout=120)
        here = str(Path(__file__).parent)
        futures = {
            client.submit(_there, here, module, function.__name__, case, pure=False): number
            for number, case in enumerate(cases)
        }
        done = track(as_completed(futures), "cases", len(futures), console=progress)
        for count, future in enumerate(done, 1):
            yield futures[future], future
            future.release()
            if not progress.is_terminal and count % EVERY == 0:
                print(f"{count} of {len(futures)}", file=sys.stderr, flush=True)


def _there(folder: str, module: str, name: str, case: Sequence[Any]) -> Any:
    """Run a case on a worker, which has to be shown the tools first."""
    if folder not in sys.path:
        sys.path.insert(0, folder)
    return getattr(importlib.import_module(module), name)(*case)


_there.__module__ = "__main__"  # so it travels by value: the workers of a scheduler know no tools yet
