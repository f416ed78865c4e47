"""Read the pages of the documentation and their code blocks."""

import re
import shlex
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

ROOT = Path(__file__).parents[2]
PAGES = sorted(
    [*ROOT.glob("docs/**/*.md"), *ROOT.glob("examples/**/*.md"), ROOT / "README.md", ROOT / "CONTRIBUTING.md"]
)
FENCE = re.compile(r"^( *)```(\w*)[^\n]*\n(.*?)^\1```", re.MULTILINE | re.DOTALL)

SHELL = re.compile(r"(#.*\n)*(magbridge [a-z]|python|pip |sudo |head |\.venv)")
"""Beginning of a code block that holds shell commands but states no language."""


class Block(NamedTuple):
    """Fenced code block: page (path from the root), first line on the page, language and text."""

    page: str
    line: int
    language: str
    text: str

    def __str__(self) -> str:
        return f"{self.page}:{self.line}"


def blocks(*languages: str) -> list[Block]:
    """Return the code blocks of all pages in the given languages."""
    return [one for page in PAGES for one in _blocks(page) if one.language in languages]


def _blocks(page: Path) -> Iterator[Block]:
    text = page.read_text(encoding="utf-8")
    for match in FENCE.finditer(text):
        lines = (line.removeprefix(match[1]) for line in match[3].splitlines())
        line = text.count("\n", 0, match.start()) + 1
        shown = "\n".join(lines) + "\n"
        language = match[2] or ("sh" if SHELL.match(shown) else "")
        yield Block(str(page.relative_to(ROOT)), line, language, shown)


def commands(block: Block) -> Iterator[list[str]]:
    """Yield the words of each command in a shell block, without comments and environment variables."""
    for line in block.text.replace("\\\n", " ").splitlines():
        for part in re.split(r" (?:&&|\|) ", line):
            words = shlex.split(part, comments=True)
            while words and re.fullmatch(r"[A-Z_]+=\S*", words[0]):
                del words[0]
            if words:
                yield words
