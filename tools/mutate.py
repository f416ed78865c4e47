"""Test the tests by mutation: change the code of important modules, and count the changes that tests detect.

    python3 tools/mutate.py                          ten changes to each module of the table below
    python3 tools/mutate.py link/estimates -n 30     thirty changes to one module
    python3 tools/mutate.py --seed 2 -n 5            other random changes

A change reverses a comparison, exchanges an operator, alters a number or omits a statement. The module's
tests then run until the first failure. The tool prints each undetected change with its line: either no test
covers the line, or the change has no effect; a reader must decide. No file is written: a fork of a process
that has imported the libraries imports the changed module.
"""

from __future__ import annotations

import ast
import copy
import importlib
import io
import os
import random
import signal
import sys
import time
import tomllib
from collections.abc import Callable, Iterator
from contextlib import redirect_stderr, redirect_stdout
from importlib.abc import Loader, MetaPathFinder
from importlib.machinery import ModuleSpec
from importlib.util import spec_from_file_location
from pathlib import Path
from types import ModuleType
from typing import Any

from studies import command_line, show, table

ROOT = Path(__file__).resolve().parents[1]
TESTS: dict[str, list[str]] = tomllib.loads((ROOT / "tools" / "mutation.toml").read_text("utf-8"))
"""Test files that must detect a change to each module."""
SLOWER = 5.0
"""Factor on the tests' normal duration after which a change counts as detected, because the tests hang."""
LIBRARIES = ("msgspec", "numpy", "pytest", "scipy.linalg", "scipy.optimize", "scipy.stats", "xarray")
OTHER: dict[type[ast.AST], type[ast.AST]] = {
    ast.Lt: ast.GtE, ast.GtE: ast.Lt, ast.Gt: ast.LtE, ast.LtE: ast.Gt,
    ast.Eq: ast.NotEq, ast.NotEq: ast.Eq, ast.Is: ast.IsNot, ast.IsNot: ast.Is,
    ast.In: ast.NotIn, ast.NotIn: ast.In, ast.And: ast.Or, ast.Or: ast.And,
    ast.Add: ast.Sub, ast.Sub: ast.Add, ast.Mult: ast.Div, ast.Div: ast.Mult,
    ast.BitAnd: ast.BitOr, ast.BitOr: ast.BitAnd, ast.Mod: ast.Mult, ast.FloorDiv: ast.Mult,
    ast.Pow: ast.Mult, ast.LShift: ast.RShift, ast.RShift: ast.LShift, ast.MatMult: ast.Add,
}  # fmt: skip


Change = tuple[ast.AST, Callable[[random.Random], None]]
"""Node, and the function that changes it in place."""


def changes(tree: ast.Module) -> Iterator[Change]:
    """Yield the possible changes of a tree: of operators, numbers, conditions and statements."""
    skipped: set[ast.AST] = set()
    for node in ast.walk(tree):
        if isinstance(node, ast.AnnAssign | ast.arg):
            skipped.update(ast.walk(node.annotation) if node.annotation else ())
        if isinstance(node, ast.FunctionDef):
            skipped.update(ast.walk(node.returns) if node.returns else ())
        names = isinstance(node, ast.Assign) and getattr(node.targets[0], "id", "") == "__all__"
        types = isinstance(node, ast.If) and getattr(node.test, "id", "") == "TYPE_CHECKING"
        if isinstance(node, ast.JoinedStr) or names or types:
            skipped.update(ast.walk(node))
    for node in ast.walk(tree):
        if node not in skipped and (function := change_of(node)):
            yield node, function


def change_of(node: Any) -> Callable[[random.Random], None] | None:
    """Return the function that changes a node in place; None if the node cannot be changed."""

    def number(rng: random.Random) -> None:
        node.value = rng.choice([node.value + 1, node.value * 2 or 3, -node.value or 2])

    def to(name: str, value: Any) -> Callable[[random.Random], None]:
        return lambda _: setattr(node, name, value)

    found: Callable[[random.Random], None] | None = None
    match node:
        case ast.Compare() if type(node.ops[0]) in OTHER:
            found = to("ops", [OTHER[type(node.ops[0])](), *node.ops[1:]])
        case ast.BinOp() | ast.AugAssign() | ast.BoolOp() if type(node.op) in OTHER:
            found = to("op", OTHER[type(node.op)]())
        case ast.UnaryOp(op=ast.USub()):
            found = to("op", ast.UAdd())
        case ast.UnaryOp(op=ast.Not()):
            found = to("operand", ast.UnaryOp(ast.Not(), node.operand))
        case ast.Constant(value=bool()):
            found = to("value", not node.value)
        case ast.Constant(value=int() | float()):
            found = number
        case ast.If() | ast.IfExp() | ast.While():
            found = to("test", ast.UnaryOp(ast.Not(), node.test))
        case (
            ast.Expr(value=ast.Call()) | ast.Raise() | ast.AugAssign() | ast.Assign(targets=[ast.Attribute()])
        ):
            found = to("__class__", ast.Pass)
    return found


class Changed(MetaPathFinder, Loader):
    """Importer that executes a syntax tree in place of the file of one module."""

    def __init__(self, name: str, path: Path, tree: ast.Module) -> None:
        self.name, self.path, self.tree = name, path, tree

    def find_spec(self, fullname: str, path: object, target: object = None) -> ModuleSpec | None:  # noqa: ARG002
        """Return the specification of the changed module; None for any other module."""
        if fullname != self.name:
            return None
        return spec_from_file_location(fullname, self.path, loader=self)

    def exec_module(self, module: ModuleType) -> None:
        """Execute the tree in the namespace of the module."""
        exec(compile(self.tree, str(self.path), "exec"), module.__dict__)


def run(module: str, tests: list[str], tree: ast.Module | None, limit: float) -> str:
    """Run the tests in a fork, with the tree in place of the module; return their outcome."""
    child = os.fork()
    if not child:
        import pytest  # noqa: PLC0415 - imported before the fork

        if tree is not None:
            name = "magbridge." + module.replace("/", ".")
            sys.meta_path.insert(0, Changed(name, ROOT / f"magbridge/{module}.py", tree))
        sink = io.StringIO()
        with redirect_stdout(sink), redirect_stderr(sink):
            code = pytest.main([*tests, "-x", "-q", "-n0", "-p", "no:cacheprovider", "-p", "no:randomly"])
        os._exit(code)
    until = time.monotonic() + limit
    while time.monotonic() < until:
        done, status = os.waitpid(child, os.WNOHANG)
        if done:
            return "lives" if status == 0 else "seen"
        time.sleep(0.02)
    os.kill(child, signal.SIGKILL)
    os.waitpid(child, 0)
    return "seen"


def main() -> int:
    """Change each module; print undetected changes and the fraction detected; return the exit code."""
    chosen = command_line(__doc__, TESTS, n=10, seed=1)
    os.chdir(ROOT)
    for library in LIBRARIES:
        importlib.import_module(library)
    shown = table("Changes", "module", "may be changed", "tried", "seen", left=("module",))
    tried = seen = 0
    for module in chosen.names:
        tests = [f"tests/{one}" for one in TESTS[module]]
        whole = ast.parse((ROOT / f"magbridge/{module}.py").read_text())
        count = len(list(changes(whole)))
        began = time.monotonic()
        if run(module, tests, None, 600.0) != "lives":
            sys.exit(f"{module}: {' '.join(tests)}: fail without a change")
        limit = 10.0 + SLOWER * (time.monotonic() - began)
        rng, own = random.Random(f"{chosen.seed} {module}"), 0
        for number in rng.sample(range(count), min(chosen.n, count)):
            tree = copy.deepcopy(whole)
            node, function = list(changes(tree))[number]
            before, line = ast.unparse(node).splitlines()[0], getattr(node, "lineno", 0)
            function(rng)
            ast.fix_missing_locations(tree)
            what = f"{before}  ->  {ast.unparse(node).splitlines()[0]}"
            ended = run(module, tests, tree, limit)
            own += ended == "seen"
            if ended != "seen":
                print(f"lives: magbridge/{module}.py:{line}: {what}", flush=True)
        shown.add_row(module, str(count), str(min(chosen.n, count)), str(own))
        tried, seen = tried + min(chosen.n, count), seen + own
    show(shown)
    print(f"{seen} of {tried} seen, {100 * seen / max(tried, 1):.0f} %")
    return 0


if __name__ == "__main__":
    sys.exit(main())
