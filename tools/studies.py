"""Common part of the studies: run cases in parallel, store their rows, and print the tables of the results.

A study consists of a function that runs one case, the columns that distinguish the lines of the table, and a
statistic for each further column. The cases are all combinations of the options that are named like the
function's parameters. ``--out FILE.parquet`` stores the rows; cases in the file are not run again.
"""

from __future__ import annotations

import argparse
import os
from collections.abc import Callable, Collection, Iterable, Iterator, Mapping, Sequence
from concurrent.futures import Future, ProcessPoolExecutor, as_completed
from dataclasses import dataclass
from inspect import signature
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from rich.console import Console
from rich.table import Table
from scipy.stats import binomtest
from threadpoolctl import threadpool_limits

from magbridge.errors import CalibrationError
from magbridge.progress import track

Row = dict[str, Any]
Statistic = Callable[[np.ndarray], float]
DATA = Path(os.environ.get("MAGBRIDGE_REAL_DATA", Path(__file__).resolve().parents[2] / "shared" / "data"))
"""Folder of the logs of real vehicles."""


def command_line(doc: str | None, names: Collection[str] = (), /, **defaults: Any) -> argparse.Namespace:
    """Return the options of a tool's command line; the help begins with the tool's docstring.

    Each keyword is an option, and its default gives the type. A list takes several values: of its own, if
    they are texts. A tuple takes one of its texts, a type has no default, and False is a switch. With `names`
    the command takes some of them as arguments, all if none is given.
    """
    parser = argparse.ArgumentParser(description=doc, formatter_class=argparse.RawDescriptionHelpFormatter)
    if names:
        parser.add_argument("names", nargs="*", metavar="NAME", help="; ".join(names).replace("%", "%%"))
    for name, default in defaults.items():
        flag = f"--{name.replace('_', '-')}" if len(name) > 1 else f"-{name}"
        if isinstance(default, bool):
            parser.add_argument(flag, action="store_true")
            continue
        several = isinstance(default, list | tuple)
        kind = default if isinstance(default, type) else type(default[0] if several else default)
        parser.add_argument(
            flag,
            type=kind,
            nargs="+" if isinstance(default, list) else None,
            choices=default if several and kind is str else None,
            default=None if kind is default else default[0] if isinstance(default, tuple) else default,
            help="default %(default)s",
        )
    options = parser.parse_args()
    if names:
        if unknown := set(options.names) - set(names):
            parser.error(f"no {', '.join(sorted(unknown))}; there are {', '.join(names)}")
        options.names = [name for name in names if name in options.names or not options.names]
    return options


def table(title: str, *headings: str, left: Collection[str] = ("",)) -> Table:
    """Return an empty table whose columns are right-aligned, except for those with a heading in `left`."""
    made = Table(title=title, title_justify="left")
    for heading in headings:
        made.add_column(heading, justify="left" if heading in left else "right")
    return made


def as_done(
    function: Callable[..., Any], cases: Sequence[Any], options: argparse.Namespace
) -> Iterator[tuple[Any, Future[Any]]]:
    """Run a function on cases (tuples of arguments) in parallel; yield case and future as each finishes."""
    with ProcessPoolExecutor(options.workers, initializer=threadpool_limits, initargs=(1,)) as pool:
        futures = {pool.submit(function, *case): case for case in cases}
        for future in track(as_completed(futures), "cases", len(futures), in_lines=True):
            yield futures[future], future


def in_order(function: Callable[..., Any], cases: Sequence[Any], options: argparse.Namespace) -> list[Any]:
    """Run a function on cases (tuples of arguments) in parallel; return the results in this order."""
    done = {id(case): future for case, future in as_done(function, cases, options)}
    return [done[id(case)].result() for case in cases]


@dataclass(frozen=True)
class Column:
    """Column of a study's table: a statistic of one or several columns of the rows.

    The statistic takes the finite values, (n,) or (n, columns), and returns a number, which `form` formats.
    """

    source: str | tuple[str, ...]
    statistic: Statistic = np.median
    form: str = ".2f"

    def cell(self, rows: pd.DataFrame) -> str:
        """Return the formatted statistic of the rows; an empty text if no row has a value."""
        names = [self.source] if isinstance(self.source, str) else list(self.source)
        if not set(names) <= set(rows):
            return ""
        values = rows[names].to_numpy(dtype=float)
        values = values[np.isfinite(values).all(axis=1)]
        values = values[:, 0] if len(names) == 1 else values
        return f"{self.statistic(values):{self.form}}" if len(values) else ""


def fraction(good: Sequence[bool] | np.ndarray) -> str:
    """Return the percentage of true values, its 95 % interval (Clopper and Pearson 1934), and the count."""
    n, k = len(good), int(np.sum(good))
    if not n:
        return "not run | 0"
    low, high = binomtest(k, n).proportion_ci()
    return f"{100 * k / n:.1f} % ({100 * low:.1f}-{100 * high:.1f}) | {k}/{n}"


def percentile(per_cent: float) -> Statistic:
    """Return the function that computes a percentile of values (n,)."""
    return lambda values: float(np.percentile(values, per_cent))


def consistent(values: np.ndarray) -> float:
    """Return the fraction of normalised errors (n,) between 0.8 and 1.25."""
    return float(np.mean((values > 0.8) & (values < 1.25)))


def combinations(run: Callable[..., Any], options: argparse.Namespace) -> list[tuple[Any, ...]]:
    """Return all combinations of the options that are named like the parameters of `run`.

    An option may be in the plural. Then a list has the values, and an integer is the number of the values,
    which are successive from the option ``first`` on.
    """
    values: list[Sequence[Any]] = []
    for name in signature(run).parameters:
        if name not in options and f"{name}s" not in options:
            break  # this parameter and the next ones have defaults
        value = vars(options).get(f"{name}s", vars(options).get(name))
        if isinstance(value, int) and not isinstance(value, bool) and f"{name}s" in options:
            first = vars(options).get("first", 0)
            value = range(first, first + value)
        values.append(value if isinstance(value, list | range) else [value])
    return list(product(*values))


def run_case(run: Callable[..., Iterable[Row]], case: tuple[Any, ...]) -> list[Row]:
    """Return the rows of a case, each with the arguments of `run`; a refused calibration is a row."""
    known: Row = {"failed": ""}
    for name, value in zip(signature(run).parameters, case, strict=False):
        known[name] = value if isinstance(value, str | int | float) else str(value)
    try:
        return [known | row for row in run(*case)]
    except CalibrationError as refused:
        return [known | {"failed": str(refused)}]


@dataclass(frozen=True)
class Study:
    """Function that runs a case of a study, and the columns of the study's table.

    `run` takes the elements of a case and returns its rows, each a dictionary, to which the study adds the
    elements under the names of the parameters. Rows with a text in ``failed`` are counted, but are not part
    of the statistics. `by` are the columns of the rows that distinguish the lines of the table; `columns` are
    further columns of the table by heading.
    """

    run: Callable[..., Iterable[Row]]
    by: tuple[str, ...]
    columns: Mapping[str, Column]

    def rows(self, cases: Sequence[tuple[Any, ...]], options: argparse.Namespace) -> pd.DataFrame:
        """Return the rows of all cases; run only the cases that the file ``--out`` lacks."""
        path: Path | None = options.out
        is_stored = path is not None and path.exists()
        kept = pd.read_parquet(path) if is_stored else pd.DataFrame({"arguments": []})
        names = [repr(case) for case in cases]
        known = set(kept["arguments"])
        todo = [(self.run, case) for case, name in zip(cases, names, strict=True) if name not in known]
        for (_, case), future in as_done(run_case, todo, options):
            new = pd.DataFrame([{"arguments": repr(case)} | row for row in future.result()])
            kept = pd.concat([kept, new], ignore_index=True) if len(kept) else new
            if path is not None:
                kept.to_parquet(path)
        order = {name: number for number, name in enumerate(names)}
        rows = kept[kept["arguments"].isin(names)]
        return rows.sort_values("arguments", key=lambda c: c.map(order), kind="stable", ignore_index=True)

    def table(self, title: str, rows: pd.DataFrame) -> Table:
        """Return the table of the rows, with a line for each combination of the columns `by`."""
        headings = (*self.by, "rows", *self.columns, "failed")
        made = table(title, *headings, left=(self.by[0], self.by[-1]))
        for key, group in rows.groupby(list(self.by), sort=False):
            good = group[group["failed"] == ""]
            cells = [column.cell(good) for column in self.columns.values()]
            failed = len(group) - len(good)
            made.add_row(*map(str, key), str(len(group)), *cells, str(failed) if failed else "")
        return made

    def main(
        self,
        doc: str | None,
        cases_of: Callable[[argparse.Namespace], Sequence[tuple[Any, ...]]] | None = None,
        /,
        **defaults: Any,
    ) -> pd.DataFrame:
        """Run the cases, print the table, and return the rows.

        The cases are :func:`combinations` of the options, or the result of `cases_of`. The other arguments
        are those of :func:`command_line`. Each study also has ``--out``, the file of the rows, and
        ``--workers``, the number of processes.
        """
        options = command_line(doc, **defaults, out=Path, workers=2)
        cases = cases_of(options) if cases_of else combinations(self.run, options)
        rows = self.rows(cases, options)
        show(self.table((doc or "").partition("\n")[0], rows))
        return rows


def show(*parts: Any) -> None:
    """Print tables and texts, wide enough for a table of many columns."""
    Console(width=190).print(*parts, sep="\n")
