"""Check the wording of Markdown pages, docstrings, comments and messages.

    python tools/prose.py PATH...     print each finding as ``path:line: rule: text -> advice``
    python tools/prose.py --gate      print the areas whose findings per 1,000 words exceed tools/limits.toml

An area is a key of ``[prose]`` in the limits: a folder or a file. A file belongs to the longest key that
matches. Standard library only.
"""

from __future__ import annotations

import ast
import io
import re
import subprocess
import sys
import tokenize
import tomllib
from collections import defaultdict
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

ROOT = Path(__file__).resolve().parents[1]
LIMITS = ROOT / "tools" / "limits.toml"
MAX_SENTENCE_WORDS, MAX_SENTENCE_NUMBERS = 25, 4
SKIPPED = ("magbridge/mavlink/enums.py", "tests/tools/test_gate.py")
"""Files that contain the forbidden words because they search for them."""

RULES: dict[str, tuple[str, str]] = tomllib.loads((ROOT / "tools" / "wording.toml").read_text("utf-8"))
"""Pattern and advice of each rule."""
NUMBER = re.compile(r"(?<![\w`./:-])[-−]?\d[\d,.]*")


class Finding(NamedTuple):
    """Violation of a rule: line, rule, text around it, and advice."""

    line: int
    rule: str
    text: str
    advice: str


def check(path: Path) -> tuple[int, list[Finding]]:
    """Return the number of words of a file's prose and the findings in it."""
    text = path.read_text(encoding="utf-8")
    if path.suffix == ".toml":  # the texts of messages: read them as those of a module
        text = repr(tomllib.loads(text))
    is_page = path.suffix == ".md"
    words, findings = 0, []
    for line, sentence in set(_page(text) if is_page else _code(text)):
        words += len(sentence.split())
        for rule, (pattern, advice) in RULES.items():
            hits = re.finditer(pattern, sentence, flags=re.MULTILINE)
            contexts = [sentence[max(0, hit.start() - 30) : hit.end() + 30] for hit in hits]
            findings += [Finding(line, rule, context, advice) for context in contexts]
        if is_page:
            findings += _lengths(line, sentence)
    return words, sorted(findings)


def _lengths(line: int, sentence: str) -> Iterator[Finding]:
    """Yield the findings about the length of a page's sentence and the numbers in it."""
    if len(sentence.split()) > MAX_SENTENCE_WORDS:
        advice = f"{len(sentence.split())} words: at most {MAX_SENTENCE_WORDS}"
        yield Finding(line, "long", sentence[:60], advice)
    if len(NUMBER.findall(sentence)) > MAX_SENTENCE_NUMBERS:
        yield Finding(line, "numbers", sentence[:60], "put the numbers in a table")


def _page(text: str) -> Iterator[tuple[int, str]]:
    """Yield line and text of each sentence of a page, without code blocks, tables and headings."""
    fenced = re.compile(r"```.*?```|<!--.*?-->", re.DOTALL)
    text = fenced.sub(lambda block: "\n" * block.group().count("\n"), text)
    start, paragraph = 1, ""
    for number, line in enumerate([*text.split("\n"), ""], 1):
        is_item = re.match(r"\s*(?:[-*+]|\d+\.|:)\s+", line)
        if not line.strip() or is_item or re.match(r"\s*[|#!<]", line):
            yield from _sentences(start, paragraph)
            start, paragraph = number, line[is_item.end() :] if is_item else ""
        else:
            start = start if paragraph else number
            paragraph += " " + line.strip()


def _sentences(line: int, text: str) -> Iterator[tuple[int, str]]:
    """Yield line and text of each sentence of a paragraph, with code as one word and links as text."""
    text = re.sub(r"`[^`]*`", "CODE", re.sub(r"\[([^\]]*)\]\([^)]*\)", r"\1", text)).replace("**", "")
    for sentence in re.split(r"(?<=[.!?])\s+(?=[A-Z(\"'*])", text):
        if sentence.strip():
            yield line, sentence.strip()


def _code(text: str) -> Iterator[tuple[int, str]]:
    """Yield line and text of each sentence in docstrings, attribute docstrings, comments and messages."""
    nodes = list(ast.walk(ast.parse(text)))
    documentation = {id(node.value): node.lineno for node in nodes if isinstance(node, ast.Expr)}
    for node in nodes:
        if not isinstance(node, ast.Constant) or not isinstance(node.value, str):
            continue
        if id(node) in documentation:
            for paragraph in re.split(r"\n\s*\n", node.value):
                yield from _sentences(node.lineno, " ".join(paragraph.split()))
        elif node.value.count(" ") > 2:
            yield node.lineno, node.value
    for token in tokenize.generate_tokens(io.StringIO(text).readline):
        if token.type == tokenize.COMMENT and "noqa" not in token.string:
            yield token.start[0], token.string.lstrip("# ")


def checkout() -> list[Path]:
    """Return the Markdown pages, Python modules and messages, without generated and quoted files."""
    command = ["git", "ls-files", "*.md", "*.py", ":(glob)magbridge/*.toml"]
    listed = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=True).stdout.split()
    return [ROOT / name for name in listed if name not in SKIPPED and (ROOT / name).is_file()]


def areas(limits: dict[str, float]) -> dict[str, tuple[int, int]]:
    """Return (findings, words) of each area of the checkout."""
    counts: dict[str, tuple[int, int]] = defaultdict(lambda: (0, 0))
    for path in checkout():
        name = path.relative_to(ROOT).as_posix()
        matches = [area for area in limits if name == area or name.startswith(area + "/")]
        folder = "/".join(name.split("/")[:2]) if name.startswith("magbridge/") else name.split("/")[0]
        area = max(matches, key=len, default=folder)
        words, findings = check(path)
        before = counts[area]
        counts[area] = before[0] + len(findings), before[1] + words
    return dict(sorted(counts.items()))


def gate() -> int:
    """Print the areas above their limit; return 1 if there are any."""
    limits = tomllib.loads(LIMITS.read_text(encoding="utf-8"))["prose"]
    over = 0
    for area, (findings, words) in areas(limits).items():
        rate, limit = 1000 * findings / max(words, 1), limits.get(area, limits["default"])
        if rate > limit and findings > 1:
            over = 1
            print(f"{area:32} {findings:5} in {words:7,} words: {rate:5.1f} per 1,000, at most {limit:.1f}")
    if over:
        print("\nprose: see each finding with: python tools/prose.py PATH")
    return over


def main() -> int:
    """Run the check; return the exit code."""
    if "--gate" in sys.argv:
        return gate()
    total = words = 0
    for path in map(Path, sys.argv[1:]):
        for file in [path] if path.is_file() else sorted([*path.rglob("*.md"), *path.rglob("*.py")]):
            count, findings = check(file)
            for line, rule, text, advice in findings:
                print(f"{file}:{line}: {rule}: …{text}… -> {advice}")
            total, words = total + len(findings), words + count
    rate = 1000 * total / max(words, 1)
    print(f"{total} findings in {words:,} words: {rate:.1f} per 1,000", file=sys.stderr)
    return int(total > 0)


if __name__ == "__main__":
    sys.exit(main())
