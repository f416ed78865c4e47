"""Check that each name in the package is descriptive and has a single meaning.

    python tools/names.py [PACKAGE]   print each finding
    python tools/names.py --gate      compare the counts of each package with tools/limits.toml

Findings: constants with several values, classes defined in several places, functions and parameters named
by a bare preposition, adverb or pronoun, and missing modules that the pages name. Standard library
only.
"""

from __future__ import annotations

import ast
import re
import sys
import tomllib
from collections import defaultdict
from collections.abc import Iterator
from pathlib import Path

ROOT = Path(__file__).resolve().parents[1]
LIMITS = ROOT / "tools" / "limits.toml"
GENERATED = "mavlink/enums.py"
"""Module that tools/dialect.py writes, with MAVLink's names."""
PLUGIN_CLASSES = {"FileWriter"}
"""Classes that each module of a plug-in interface defines, with one meaning and several implementations."""
BARE = (
    "about after ago ahead alone among apart at back before behind below beside between beyond by down else "
    "even here inside instead near now of off often on once one other others ours out over own past since so "
    "some such then there through together under until up what when where which who whole whose why with "
    "within without"
)


def check(package: Path) -> dict[str, list[str]]:
    """Return the findings in a package by kind."""
    constants: dict[str, dict[str, str]] = defaultdict(dict)
    classes: dict[str, list[str]] = defaultdict(list)
    functions, parameters = [], []
    for path in sorted(package.rglob("*.py")):
        if path.as_posix().endswith(GENERATED):
            continue
        tree = ast.parse(path.read_text(encoding="utf-8"))
        for name, value in _constants(tree):
            constants[name][str(path)] = value
        for node in ast.walk(tree):
            if isinstance(node, ast.ClassDef) and node.name not in PLUGIN_CLASSES:
                classes[node.name].append(f"{path}:{node.lineno}")
            elif isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef):
                if node.name.strip("_") in BARE.split():
                    functions.append(f"{path}:{node.lineno}: function {node.name}")
                arguments = (*node.args.posonlyargs, *node.args.args, *node.args.kwonlyargs)
                names = [argument.arg for argument in arguments if argument.arg.strip("_") in BARE.split()]
                if node.name.startswith("__") and names == ["other"]:  # Python's name for an operand
                    names = []
                parameters += [f"{path}:{node.lineno}: parameter {name} of {node.name}" for name in names]
    return {
        "constants": [
            f"constant {name} has {len(set(values.values()))} values: {', '.join(values)}"
            for name, values in sorted(constants.items())
            if len(set(values.values())) > 1
        ],
        "classes": [
            f"class {name} is defined {len(places)} times: {', '.join(places)}"
            for name, places in sorted(classes.items())
            if len(places) > 1
        ],
        "functions": functions,
        "parameters": parameters,
    }


def _constants(tree: ast.Module) -> Iterator[tuple[str, str]]:
    """Yield name and value of the constants of a module."""
    for node in tree.body:
        if isinstance(node, ast.Assign):
            targets = node.targets
        elif isinstance(node, ast.AnnAssign):
            targets = [node.target]
        else:
            continue
        for target in targets:
            if isinstance(target, ast.Name) and re.fullmatch(r"[A-Z][A-Z0-9_]+", target.id) and node.value:
                yield target.id, ast.unparse(node.value)


def missing_modules() -> list[str]:
    """Return a line for each module that a page names in code and that the checkout lacks."""
    paths = [path.relative_to(ROOT) for path in ROOT.rglob("*") if path.suffix in {".md", ".py"}]
    paths = [path for path in paths if not path.parts[0].startswith(".")]
    modules = [f"/{path.as_posix()}" for path in paths if path.suffix == ".py"]
    found: list[str] = []
    for page in sorted(path for path in paths if path.suffix == ".md"):
        named = re.findall(r"`([\w/]+/[\w/]+\.py)`", (ROOT / page).read_text(encoding="utf-8"))
        missing = [name for name in named if not any(module.endswith("/" + name) for module in modules)]
        found += [f"{page}: module {name} does not exist" for name in missing]
    return found


def gate() -> int:
    """Print the kinds of findings above their limit, and missing modules; return 1 if there are any."""
    over = False
    for package, limits in tomllib.loads(LIMITS.read_text(encoding="utf-8"))["names"].items():
        for kind, findings in check(ROOT / package).items():
            if len(findings) > limits.get(kind, 0):
                over = True
                print(f"{package}: {len(findings)} {kind}, at most {limits.get(kind, 0)}")
    missing = missing_modules()
    if missing:
        print(*missing, sep="\n")
    if over:
        print("\nnames: see each finding with: python tools/names.py PACKAGE")
    return int(over or bool(missing))


def main() -> int:
    """Run the check; return the exit code."""
    if "--gate" in sys.argv:
        return gate()
    findings = check(Path(sys.argv[1]) if sys.argv[1:] else ROOT / "magbridge")
    for kind in findings:
        print(*findings[kind], sep="\n")
    print(", ".join(f"{len(found)} {kind}" for kind, found in findings.items()), file=sys.stderr)
    return int(any(findings.values()))


if __name__ == "__main__":
    sys.exit(main())
