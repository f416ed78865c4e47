"""Run a command as a user types it, and return its output or the line of its error message."""

import json
from typing import Any, NamedTuple

import pytest

from magbridge.cli import main


class Output(NamedTuple):
    """Text that a command printed to stdout and stderr."""

    out: str
    err: str


class Command:
    """Runner of ``magbridge`` commands in the process of the test."""

    def __init__(self, capsys: pytest.CaptureFixture[str]) -> None:
        self._capsys = capsys

    def __call__(self, *arguments: object, code: int = 0) -> Output:
        """Run a command, assert that its exit code is `code`, and return its output."""
        assert main([str(argument) for argument in arguments]) == code
        return Output(*self._capsys.readouterr())

    def json(self, *arguments: object, code: int = 0) -> Any:
        """Run a command with ``--json``, assert that its exit code is `code`, and return its result."""
        return json.loads(self(*arguments, "--json", code=code).out)

    def refuses(self, *arguments: object, code: int = 1) -> str:
        """Run a command, assert that it fails with `code` and one line on stderr, and return that line."""
        texts = self(*arguments, code=code).err
        assert texts.count("\n") == 1, texts
        assert texts.startswith("magbridge: ")
        return texts.removeprefix("magbridge: ").rstrip()
