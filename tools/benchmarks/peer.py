"""Encode and decode MAVLink by the classes that pymavlink generates: the floor of the benchmarks."""

from __future__ import annotations

import importlib.util
import shutil
import tempfile
from collections.abc import Iterable
from contextlib import redirect_stdout
from functools import cache
from io import StringIO
from pathlib import Path
from types import ModuleType
from typing import Any

import pymavlink
from pymavlink.generator import mavgen

import magbridge.mavlink


@cache
def classes() -> ModuleType:
    """Return the Python module that mavgen generates from the project's XML dialect."""
    with tempfile.TemporaryDirectory() as name, redirect_stdout(StringIO()):
        folder = Path(name)
        shutil.copy(Path(magbridge.mavlink.__file__).with_name("magbridge.xml"), folder)
        for included in ("common", "standard", "minimal"):
            shutil.copy(Path(pymavlink.__file__).parent / "dialects" / "v20" / f"{included}.xml", folder)
        options = mavgen.Opts(str(folder / "peer"), wire_protocol="2.0", language="Python3")
        if not mavgen.mavgen(options, [str(folder / "magbridge.xml")]):
            raise RuntimeError("mavgen refused magbridge.xml")
        place = importlib.util.spec_from_file_location("peer", folder / "peer.py")
        if place is None or place.loader is None:
            raise ImportError("peer.py")
        module = importlib.util.module_from_spec(place)
        place.loader.exec_module(module)
    return module


class Peer:
    """pymavlink's codec, which decodes the bridge's input and encodes its output."""

    def __init__(self) -> None:
        self._in = classes().MAVLink(None)
        self._in.robust_parsing = True
        self._out = classes().MAVLink(None, srcSystem=1, srcComponent=191)

    def decode(self, pieces: Iterable[bytes]) -> int:
        """Decode bytes in pieces; return the number of messages."""
        return sum(len(self._in.parse_buffer(piece) or ()) for piece in pieces)

    def arguments(self, published: bytes) -> list[tuple[type, tuple[Any, ...]]]:
        """Return class and arguments of each message of a stream, for :meth:`encode`."""
        reader = classes().MAVLink(None)
        messages = reader.parse_buffer(published) or []
        return [(type(one), tuple(self._argument(one, name) for name in one.fieldnames)) for one in messages]

    def sensor_bytes(self, data: bytes) -> tuple[type, tuple[Any, ...]]:
        """Return class and arguments of the log's message that stores the bytes of a sensor."""
        kind = classes().MAVLink_mag_sensor_bytes_message
        return kind, (0, len(data), list(data.ljust(253, b"\0")))

    @staticmethod
    def _argument(message: Any, name: str) -> Any:
        value = getattr(message, name)
        return value.encode() if isinstance(value, str) else value

    def encode(self, messages: Iterable[tuple[type, tuple[Any, ...]]]) -> int:
        """Construct and pack messages; return the number of bytes."""
        out = self._out
        return sum(len(kind(*arguments).pack(out)) for kind, arguments in messages)
