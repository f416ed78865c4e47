"""Run the commands of the documentation's pages in a folder with a user's files."""

import shlex
from pathlib import Path

import pytest
from commands import Command, Output
from pages import blocks, commands

SHOWN = {tuple(words) for block in blocks("sh") for words in commands(block)}


class Walk:
    """Runner that accepts only commands that the documentation shows."""

    def __init__(self, command: Command) -> None:
        self._command = command

    def __call__(self, line: str, code: int = 0) -> Output:
        """Run a command line that a page shows word for word; assert that its exit code is `code`."""
        words = tuple(shlex.split(line))
        assert words in SHOWN, f"no page shows: {line}"
        files = [name for word in words[1:] for name in _globbed(word)]
        return self._command(*files, code=code)


def _globbed(word: str) -> list[str]:
    """Return the files that match a pattern as a shell expands it; return the word itself if none matches."""
    return (
        [word] if "*" not in word or word.startswith("/") else sorted(map(str, Path().glob(word))) or [word]
    )


@pytest.fixture
def walk(command: Command) -> Walk:
    return Walk(command)
