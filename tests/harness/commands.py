"""A command as a user types it: its output, or the one line of its error message."""

from __future__ import annotations

from typing import NamedTuple

import pytest

from magbridge.cli import main

__all__ = ["Command", "Output"]


class Output(NamedTuple):
    """What a command printed."""

    out: str
    err: str


class Command:
    """Runs ``magbridge`` in this process."""

    def __init__(self, capsys: pytest.CaptureFixture[str]) -> None:
        self._capsys = capsys

    def __call__(self, *arguments: object, code: int = 0) -> Output:
        """Run a command that must end with `code`; return its output."""
        assert main([str(argument) for argument in arguments]) == code
        return Output(*self._capsys.readouterr())

    def refuses(self, *arguments: object, code: int = 1) -> str:
        """Run a command that must refuse with `code`; return its one line."""
        texts = self(*arguments, code=code).err
        assert texts.count("\n") == 1, texts
        assert texts.startswith("magbridge: ")
        return texts.removeprefix("magbridge: ").rstrip()
