"""Decode the bridge's messages like a ground station."""

from __future__ import annotations

from array import array
from collections import Counter

import numpy as np

from magbridge.arrays import FloatArray
from magbridge.mavlink import Codec, spec
from magbridge.mavlink.enums import MAG_NAVIGATION_STATE
from magbridge.records import Quality

FIELD, TEXT, NAVIGATION = spec("MAG_FIELD"), spec("STATUSTEXT"), spec("MAG_NAVIGATION")
COLUMNS = {
    "time": "time_usec",
    "total_field": "total_field",
    "sigma": "total_field_sigma",
    "field_x": "x",
    "field_y": "y",
    "field_z": "z",
    "quality": "flags",
}
"""Field of MAG_FIELD that each column of :meth:`Listener.field` contains."""
SENSOR_ID = FIELD.fields["sensor_id"]


class Listener:
    """Receiver that counts messages, and stores the corrected field and the STATUSTEXTs in `texts`.

    `navigation` counts the MAG_NAVIGATION messages by their state.
    """

    def __init__(self) -> None:
        self.texts: list[str] = []
        self.navigation: Counter[str] = Counter()
        self._counts: Counter[int] = Counter()
        self._codec = Codec(255, 190)
        self._fields = [FIELD.fields[name] for name in COLUMNS.values()]
        self._values = array("d")

    @property
    def counts(self) -> dict[str, int]:
        """Number of received messages, by message name."""
        return {spec(number).name: count for number, count in self._counts.items()}

    def receive(self, data: bytes) -> None:
        """Decode received bytes; a message may be split between calls."""
        for message in self._codec.parse(data):
            self._counts[message.id] += 1
            if message.id == FIELD.id and not SENSOR_ID.get(message.payload):
                self._values.extend(field.get(message.payload) for field in self._fields)
            elif message.id == TEXT.id:
                self.texts.append(message["text"])
            elif message.id == NAVIGATION.id:
                self.navigation[MAG_NAVIGATION_STATE(message["state"]).name.lower()] += 1

    def field(self) -> dict[str, FloatArray]:
        """Return the corrected field as columns (n,): ``time`` (s since 1970 UTC), nT, and ``quality``."""
        table = np.array(self._values).reshape(-1, len(COLUMNS))
        columns = dict(zip(COLUMNS, table.T, strict=True))
        return {**columns, "time": columns["time"] * 1e-6}

    def flags(self) -> dict[str, int]:
        """Return the number of samples with each flag, by the flag's public name."""
        quality = self.field()["quality"].astype(int)
        counts = {flag.names(): int((quality & flag != 0).sum()) for flag in Quality}
        return {name: count for name, count in counts.items() if count}
