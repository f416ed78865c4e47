"""Test that docstrings state an array's shape, the errors raised, and the meaning of a constant."""

import ast
import re
from functools import cache
from pathlib import Path

import magbridge
import sitl
from magbridge import errors

ROOMS = [Path(str(package.__file__)).parent for package in (magbridge, sitl)]
ERRORS = {name for name, thing in vars(errors).items() if isinstance(thing, type)}
SHAPE = re.compile(r"\((\.\.\.|[\w+ ]+),[\w+*., ()-]*\)|\bshape\b|[Aa]rguments as")
"""``(n,)``, ``(n, 3)``, ``(..., 9 m)``, or a reference to the place that states it."""


def functions(scope: ast.Module | ast.ClassDef) -> list[ast.FunctionDef]:
    """Return the functions with a docstring; overloads and setters of properties have none."""
    return [n for n in scope.body if isinstance(n, ast.FunctionDef) and ast.get_docstring(n)]


@cache
def trees() -> dict[Path, ast.Module]:
    """Return the syntax tree of every module of the packages."""
    return {path: ast.parse(path.read_text()) for room in ROOMS for path in room.rglob("*.py")}


def offered(tree: ast.Module) -> list[str]:
    """Return the names in a module's ``__all__``."""
    assigned = [n for n in tree.body if isinstance(n, ast.Assign)]
    lists = [n.value for n in assigned if ast.unparse(n.targets[0]) == "__all__"]
    return list(ast.literal_eval(lists[0])) if lists else []


@cache
def public() -> dict[str, ast.FunctionDef]:
    """Return the functions in ``__all__`` and the methods of its classes that override no other method."""
    classes = {n.name: n for tree in trees().values() for n in tree.body if isinstance(n, ast.ClassDef)}

    def above(one: ast.ClassDef) -> set[str]:
        bases = [classes[base.id] for base in one.bases if isinstance(base, ast.Name) and base.id in classes]
        return {n.name for base in bases for n in functions(base)}.union(*map(above, bases))

    found: dict[str, ast.FunctionDef] = {}
    for path, tree in trees().items():
        names = offered(tree)
        own = [n for n in functions(tree) if n.name in names]
        for one in (n for n in tree.body if isinstance(n, ast.ClassDef) and n.name in names):
            own += [n for n in functions(one) if n.name[0] != "_" and n.name not in above(one)]
        found |= {f"{path}:{n.lineno} {n.name}": n for n in own}
    assert len(found) > 500
    return found


def test_all_lists_what_other_modules_import() -> None:
    """So that a list is true; modules inside a package, of one caller each, may have none."""
    modules = {".".join(path.relative_to(ROOMS[0].parent).with_suffix("").parts): path for path in trees()}
    modules = {name.removesuffix(".__init__"): path for name, path in modules.items()}
    imports = [n for tree in trees().values() for n in ast.walk(tree) if isinstance(n, ast.ImportFrom)]
    wanted = {(n.module, alias.name) for n in imports if n.module in modules for alias in n.names}
    assert len(wanted) > 500
    hidden = [
        f"{module}: {name}"
        for module, name in sorted(wanted)
        if f"{module}.{name}" not in modules
        and (listed := offered(trees()[modules[module]]))
        and name not in listed
    ]
    assert not hidden


def test_an_array_has_a_shape() -> None:
    def kinds(function: ast.FunctionDef) -> str:
        given = [n.annotation for n in ast.walk(function.args) if isinstance(n, ast.arg)]
        return " ".join(ast.unparse(kind) for kind in (*given, function.returns) if kind)

    silent = [
        where
        for where, function in public().items()
        if re.search(r"Array\b", kinds(function)) and not SHAPE.search(str(ast.get_docstring(function)))
    ]
    assert not silent


def test_an_error_that_is_raised_is_named() -> None:
    """Commands are an exception: ``--help`` prints their docstrings, and their errors are exit codes."""

    def raised(function: ast.FunctionDef) -> set[str]:
        thrown = [n.exc for n in ast.walk(function) if isinstance(n, ast.Raise)]
        return {ast.unparse(one.func) for one in thrown if isinstance(one, ast.Call)} & ERRORS

    silent = [
        where
        for where, function in public().items()
        if "/cli/" not in where
        and not all(name in str(ast.get_docstring(function)) for name in raised(function))
    ]
    assert not silent


def test_what_a_constant_means_stands_below_it() -> None:
    """Where an editor and the documentation find it, in one style; a comment there is for a linter."""
    trailing = re.compile(r"^[A-Z][A-Z_0-9, ]*(: [^=]+)? = .*  # (?!noqa|fmt:|type:)", re.MULTILINE)
    found = [
        f"{path}: {match[0]}"
        for room in ROOMS
        for path in room.rglob("*.py")
        for match in trailing.finditer(path.read_text())
        if "TYPE_CHECKING" not in match[0]
    ]
    assert not found


def test_a_name_in_a_docstring_exists() -> None:
    """A reference, or the type of a parameter, must not keep the name of something that was renamed."""
    nodes = [n for tree in trees().values() for n in ast.walk(tree)]
    defined = {path.stem for path in trees()} | {room.name for path in trees() for room in path.parents}
    defined |= {n.name for n in nodes if isinstance(n, ast.ClassDef | ast.FunctionDef)}
    defined |= {n.id for n in nodes if isinstance(n, ast.Name)}
    defined |= {n.arg for n in nodes if isinstance(n, ast.arg)}
    defined |= {n.attr for n in nodes if isinstance(n, ast.Attribute)}
    defined |= {(n.asname or n.name).rpartition(".")[2] for n in nodes if isinstance(n, ast.alias)}
    reference = re.compile(r":(?:class|func|meth|attr|data|mod|exc):`~?([\w.]+)`")
    parameter = re.compile(r"^ *[\w, *]+ : ([A-Z]\w+)(?:,|$)", re.MULTILINE)
    missing = [
        f"{path}: {name}"
        for path, tree in trees().items()
        for n in ast.walk(tree)
        if isinstance(n, ast.Module | ast.ClassDef | ast.FunctionDef)
        for name in reference.findall(ast.get_docstring(n) or "")
        + parameter.findall(ast.get_docstring(n) or "")
        if name.rpartition(".")[2] not in defined
    ]
    assert not missing, missing
