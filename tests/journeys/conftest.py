"""A first hour: the commands of a page, as it has them, in a folder with a file like theirs."""

from __future__ import annotations

import shlex
from pathlib import Path

import pytest
from commands import Command, Output
from pages import blocks, commands

SHOWN = {tuple(words) for block in blocks("sh") for words in commands(block)}


class Walk:
    """Runs commands that the documentation shows, and no others."""

    def __init__(self, command: Command) -> None:
        self._command = command

    def __call__(self, line: str, code: int = 0) -> Output:
        """Run a line as a page has it, word for word, which must end with `code`."""
        words = tuple(shlex.split(line))
        assert words in SHOWN, f"no page shows: {line}"
        files = [name for word in words[1:] for name in _globbed(word)]
        return self._command(*files, code=code)


def _globbed(word: str) -> list[str]:
    """Return the files that a shell would put in place of a pattern; one that fits none stays."""
    return (
        [word] if "*" not in word or word.startswith("/") else sorted(map(str, Path().glob(word))) or [word]
    )


@pytest.fixture
def walk(command: Command) -> Walk:
    return Walk(command)
