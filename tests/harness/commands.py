"""A command as a user types it: what it prints, and the one line with which it refuses."""

from __future__ import annotations

from typing import NamedTuple

import pytest

from magbridge.cli import main

__all__ = ["Command", "Said"]


class Said(NamedTuple):
    """What a command printed."""

    out: str
    err: str


class Command:
    """Runs ``magbridge`` in this process."""

    def __init__(self, capsys: pytest.CaptureFixture[str]) -> None:
        self._capsys = capsys

    def __call__(self, *arguments: object, code: int = 0) -> Said:
        """Run a command that must end with `code`; return what it printed."""
        assert main([str(argument) for argument in arguments]) == code
        return Said(*self._capsys.readouterr())

    def refuses(self, *arguments: object, code: int = 1) -> str:
        """Run a command that must refuse with `code`; return its one line."""
        said = self(*arguments, code=code).err
        assert said.count("\n") == 1, said
        assert said.startswith("magbridge: ")
        return said.removeprefix("magbridge: ").rstrip()
