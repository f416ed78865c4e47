"""Read a ``bridge.toml`` as immutable settings.

All keys and types are checked before a port is opened; an error is one line. Paths in the file are relative
to the file.
"""

from __future__ import annotations

import hashlib
from collections.abc import Callable
from math import inf, isfinite
from pathlib import Path
from typing import Annotated, Any, Literal, TypeVar

import msgspec
from msgspec import Meta

from magbridge.constants import MAIN_FIELD_SIGMA_NT
from magbridge.errors import ConfigError, DataError
from magbridge.toml import Table, check_entries, convert, load_toml

__all__ = [
    "Align", "CalibrationFile", "Config", "HeadingOutput", "Learning", "Link", "Log", "Navigation",
    "NotNegative", "Positive", "Sensor", "Telemetry", "load", "parse",
]  # fmt: skip

T = TypeVar("T")
Positive = Annotated[float, Meta(gt=0, le=1e9)]
NotNegative = Annotated[float, Meta(ge=0, le=1e9)]
"""`Positive`, `NotNegative`: Numbers with an upper bound, because deadlines and sizes become integers."""
Rate = Annotated[float, Meta(ge=-1e9, le=1e9)]
Name = Annotated[str, Meta(min_length=1)]
SystemId = Annotated[int, Meta(ge=1, le=255)]
Baudrate = Annotated[int, Meta(gt=0, le=20_000_000)]
"""Baud rate, bounded because larger values would only be rejected when the port is opened."""


MAX_BRIDGE_SENSORS = 4
"""Largest number of sensors of a bridge; the log can number only as many ports."""


class Sensor(Table, frozen=True):
    """``[sensor]``, or ``[sensor.NAME]`` for each of several sensors: instrument and port."""

    driver: str
    """Name of the driver, a key of :data:`magbridge.sensors.DRIVERS`."""
    port: Name
    """Port: a device, a pyserial URL (``socket://``, ``rfc2217://``, ``loop://``), an RM3100 on a bus
    (``i2c:1:0x20``, ``spi:0.0``), or a pattern such as ``/dev/ttyUSB*``. A pattern selects the first device
    that sends a reading within `timeout`. The bridge does not send start-up commands to a device that sends
    NMEA 0183."""
    baudrate: Baudrate = 9600
    """Baud rate, bit/s."""
    timeout: Positive = 10.0
    """Time without a reading after which the sensor counts as silent, s."""
    options: dict[str, Any] = msgspec.field(default_factory=dict)
    """Settings of the driver."""
    name: Annotated[str, Meta(max_length=16, pattern=r"^\w*$")] = ""
    """NAME of ``[sensor.NAME]``, by which messages and the log identify the sensor; not a key of the file."""
    id: Annotated[int, Meta(ge=0, lt=MAX_BRIDGE_SENSORS)] | None = None
    """``sensor_id`` in all messages; by default the sensors are numbered from 0 in the order of the file.
    Sensor 0 is the main sensor: heading, learning and navigation use it."""
    calibration: Name | None = None
    """The ``cal.json`` of this sensor; for sensor 0, ``calibration.file`` may give it instead. The default of
    a scalar sensor is the calibration of sensor 0, if that calibration has an entry for the scalar sensor."""
    sigma: Positive | None = None
    """1-sigma of a scalar sensor's reading at its mounting position, nT. With this key the scalar sensor does
    not need a calibration."""
    filter_delay: NotNegative | None = None
    """Delay of the sensor's filter, s, instead of ``align.filter_delay``. The default for a scalar sensor is
    0, because its calibration includes the lag."""

    @property
    def label(self) -> str:
        """Return the name of the sensor in messages."""
        return self.name or self.driver

    @property
    def key(self) -> str:
        """Return the dotted key of the sensor's table."""
        return f"sensor.{self.name}" if self.name else "sensor"


class Link(Table, frozen=True):
    """``[link]``: the MAVLink connection."""

    url: Name
    """MAVLink URL: ``udpin:``, ``udpout:``, ``tcp:``, ``tcpin:`` and ``HOST:PORT`` or
    ``[IPV6]:PORT``, or a serial device."""
    system: SystemId = 1
    """System id of the vehicle, which the bridge uses, and from which alone it accepts messages."""
    component: SystemId = 191
    """Component id of the bridge; 191 is an onboard computer."""
    autopilot: SystemId = 1
    """Component id of the autopilot."""
    baudrate: Baudrate = 57600
    """Baud rate of a serial link, bit/s."""
    signing_key: Name | None = None
    """File of 32 bytes, with which packets are signed; the bridge rejects unsigned packets."""
    max_other_peers_rate: NotNegative = 1000.0
    """Largest total data rate to all peers except the autopilot, kB/s, on ``udpin`` and ``tcpin``."""
    request_streams: bool = True
    """Request from the autopilot the messages that the bridge needs, if they arrive too rarely."""
    parameters: Name | None = None
    """File that stores parameters changed over the link; by default ``bridge.parameters.json`` next to a
    configuration called ``bridge.toml``."""

    def __post_init__(self) -> None:
        if self.component == self.autopilot:
            raise ValueError(f"component: expected another number than the autopilot's, got {self.autopilot}")

    @property
    def shared(self) -> bool:
        """Return True if the link can have several peers, so that the frames of each are read separately."""
        return self.url.startswith(("udpin:", "tcpin:"))


MAX_DELAY_S = 600.0
"""Longest delay of telemetry, s."""


class Telemetry(Table, frozen=True):
    """``[telemetry.NAME]``: a field of a MAVLink message that becomes the parameter NAME."""

    message: str
    """Name of the MAVLink message, such as ``NAMED_VALUE_FLOAT``."""
    field: str
    """Name of a field of the message, with an index if it is an array: ``actuator[2]``."""
    match: dict[str, str | int | float] = msgspec.field(default_factory=dict)
    """Values that other fields of the message must have."""
    scale: float = 1.0
    offset: float = 0.0
    """`scale`, `offset`: Conversion, ``value = scale * message.field + offset``."""
    unit: str = ""
    """Unit of the parameter, as in the calibration."""
    max_age: Positive = 30.0
    """Age from which a value is stale, s."""
    delay: float = 0.0
    """Delay of the telemetry, s: a value with the time stamp t was measured at t - delay."""
    component: SystemId | None = None
    """Id of the component whose messages are used; by default the autopilot, else the first that sends."""

    def __post_init__(self) -> None:
        if not 0.0 < abs(self.scale) < inf:
            raise ValueError(f"scale: expected a finite number other than 0, got {self.scale}")
        if not isfinite(self.offset):
            raise ValueError(f"offset: expected a finite number, got {self.offset}")
        if not abs(self.delay) <= MAX_DELAY_S:
            raise ValueError(f"delay: expected at most {MAX_DELAY_S:g} s either way, got {self.delay}")


class CalibrationFile(Table, frozen=True):
    """``[calibration]``: the calibration to correct with."""

    file: Name
    """Path of the calibration (``cal.json``)."""


class Align(Table, frozen=True):
    """``[align]``: time alignment of channels and telemetry; each key is also a MAVLink parameter."""

    filter_delay: NotNegative = 0.0
    """Delay of the channels in the anti-alias filter, s."""
    gap_factor: Annotated[float, Meta(gt=1, le=1e9)] = 2.5
    """Number of sample periods without a sample from which a pause is a gap."""
    moving_rate: Positive = 0.005
    """Rate from which a parameter is moving, as a fraction of its calibrated range per second."""
    settle_time: NotNegative = 0.0
    """Time after a motion during which samples stay flagged ``moving``, s."""
    stale_growth: NotNegative = 1.0
    """Growth of the sigma with the age of stale telemetry, nT/s."""
    turn_on_sigma: NotNegative = 20.0
    """1-sigma of the change of the sensor's offset at a power-on, nT."""
    reference_sigma: Positive = MAIN_FIELD_SIGMA_NT
    """1-sigma of the Earth's total field about the main-field model, nT. A corrected field that differs by
    more than five sigma is flagged ``implausible``."""


class Navigation(Table, frozen=True):
    """``[navigation]``: position by matching the corrected field to an anomaly map."""

    map: Name
    """File of the anomaly grid."""
    fix: str = "EXTERNAL_POSITION_ESTIMATE"
    """Message that sends a fix to the autopilot: ``EXTERNAL_POSITION_ESTIMATE`` (ArduPilot and PX4, the
    default), ``ODOMETRY`` (ArduPilot) or ``GLOBAL_POSITION_SENSOR`` (PX4)."""
    rate: NotNegative | None = None
    """Rate of the fixes, Hz; fixes between updates of the filter are dead-reckoned. 0 sends a fix with each
    update. Default 5 for ``ODOMETRY``, else 0."""
    depth: NotNegative = 0.0
    """Depth of the deepest dive, m; a map of known altitude is continued to half this depth."""
    options: dict[str, Any] = msgspec.field(default_factory=dict)
    """Prior uncertainties and settings of the position filter: the fields of
    :class:`magbridge.navigate.NavigationOptions`."""


class HeadingOutput(Table, frozen=True):
    """``[heading]``: heading from the corrected field and the autopilot's roll and pitch."""

    send: Literal["odometry", "vision_position_estimate"] | None = None
    """Message that sends the heading to the autopilot as a yaw: ``odometry`` or ``vision_position_estimate``.
    By default the heading is not sent."""
    rate: NotNegative = 10.0
    """Rate of the message `send`, Hz; 0 sends it with every sample. ArduPilot needs 4 Hz at least, PX4
    10 Hz."""
    tilt_sigma: Positive | None = None
    """1-sigma of the autopilot's roll and pitch, deg; by default the value from the calibration runs."""
    nmea: Name | None = None
    """Port for the NMEA 0183 sentences HDG, HDT and PASHR: ``udp:HOST:PORT`` or a serial device."""
    nmea_baudrate: Baudrate = 4800
    """Baud rate, bit/s, if `nmea` is a serial device."""
    nmea_rate: Positive = 1.0
    """Rate of the NMEA sentences, Hz."""


class Learning(Table, frozen=True):
    """``[learning]``: recursive estimation of the calibration's coefficients in flight."""

    enabled: bool = False
    """True to learn from the start of the bridge; the parameter ``MB_LEARN`` changes this over the link."""
    reference: Name = "igrf"
    """Reference field: ``igrf``, or the file of an anomaly grid to add to the IGRF."""
    map_sigma: NotNegative = 20.0
    position_sigma: NotNegative = 100.0
    """`map_sigma`, `position_sigma`: 1-sigma of the anomaly grid, nT, and of the vehicle's position, m."""
    prior: Name | None = None
    """Calibration file with the prior for vehicles of this class; used without ``[calibration]``."""
    ranges: dict[str, tuple[float, float]] = msgspec.field(default_factory=dict)
    """Lowest and highest value of each moving mass; used without ``[calibration]`` and `prior`, with a prior
    for any vehicle."""
    max_rate: Annotated[float, Meta(gt=0, le=20)] = 1.0
    """Largest rate of the samples used for learning, Hz."""
    directory: Name | None = None
    """Folder for the learned calibrations; by default the folder of the calibration's file."""

    def __post_init__(self) -> None:
        for name, (low, high) in self.ranges.items():
            if not -1e12 < low < high < 1e12:
                raise ValueError(f"ranges.{name}: expected lowest and highest, got {low:g} and {high:g}")


class Log(Table, frozen=True):
    """``[log]``: folder and file sizes of the telemetry log."""

    directory: str
    """Folder of the log's files."""
    max_size: Positive = 64.0
    """Largest size of a file, MB."""
    max_age: Positive = 24.0
    """Longest time that a file covers, h."""


class Config(Table, frozen=True):
    """Settings of a bridge: the contents of a ``bridge.toml``.

    `publish` is the rate of each message, Hz: 0 sends it with every sample, a negative rate never. `path` is
    the file itself, `digest` the first 8 bytes of its SHA-256 in hex. With several ``[sensor.NAME]`` tables,
    `sensor` is the sensor with the id 0, and `more_sensors` are the others.
    """

    sensor: Sensor
    link: Link
    telemetry: dict[str, Telemetry] = msgspec.field(default_factory=dict)
    calibration: CalibrationFile | None = None
    align: Align = Align()
    publish: dict[str, Rate] = msgspec.field(default_factory=lambda: {"MAG_FIELD": 0.0})
    log: Log | None = None
    heading: HeadingOutput = HeadingOutput()
    navigation: Navigation | None = None
    learning: Learning | None = None
    more_sensors: tuple[Sensor, ...] = ()
    path: Path = Path("bridge.toml")
    digest: str = ""

    @property
    def sensors(self) -> tuple[Sensor, ...]:
        """All sensors in the order of their ids: `sensor`, then `more_sensors`."""
        return self.sensor, *self.more_sensors

    @property
    def files(self) -> dict[str, str | None]:
        """Dotted key -> name of a file that must exist; None if the key is not given."""
        learning = self.learning or Learning()
        return {
            "calibration.file": self.calibration.file if self.calibration else None,
            "link.signing_key": self.link.signing_key,
            "navigation.map": self.navigation.map if self.navigation else None,
            "learning.reference": learning.reference if learning.reference != "igrf" else None,
            "learning.prior": learning.prior,
            **{f"sensor.{one.name}.calibration": one.calibration for one in self.more_sensors},
        }

    def resolve(self, name: str) -> Path:
        """Return the path of a file named in the configuration, relative to the configuration's folder."""
        return self.path.parent / Path(name).expanduser()

    def read(self, key: str, reader: Callable[[Path], T]) -> T | None:
        """Return what `reader` reads from the file of a `key` of :attr:`files`; ConfigError: it cannot."""
        if (name := self.files[key]) is None:
            return None
        try:
            return reader(self.resolve(name))
        except DataError as error:
            raise ConfigError(self.path, key, str(error)) from error


def load(path: str | Path) -> Config:
    """Read and check a ``bridge.toml``.

    ConfigError: the file is missing or not TOML, a key is unknown or missing, a value has the wrong type or
    range, or a file that it names does not exist.
    """
    path = Path(path)
    config = parse(load_toml(path), path)
    config = msgspec.structs.replace(config, digest=hashlib.sha256(path.read_bytes()).hexdigest()[:16])
    for key, name in config.files.items():
        if name is not None and not config.resolve(name).exists():
            raise ConfigError(path, key, f"no such file: {config.resolve(name)}")
    return config


def parse(table: dict[str, Any], path: Path) -> Config:
    """Convert the table of a ``bridge.toml`` to settings without digest; ConfigError: as :func:`load`."""
    for reserved in ("path", "digest", "more_sensors"):
        if reserved in table:
            raise ConfigError(path, reserved, "unknown key")
    check_entries(table, "telemetry", Telemetry, path)
    check_entries(table, "publish", Rate, path)
    named = _named_sensors(table.get("sensor"))
    tables = {f"sensor.{name}": one for name, one in named.items()} or {"sensor": table.get("sensor")}
    for key, one in tables.items():
        if isinstance(one, dict) and "name" in one:
            raise ConfigError(path, f"{key}.name", "unknown key; name the sensor in the head, [sensor.NAME]")
    if not named:
        config = convert(table, Config, path)
        sensors = [config.sensor]
    else:
        check_entries(table, "sensor", Sensor, path)
        sensors = [
            convert({**one, "name": key}, Sensor, path, f"sensor.{key}.") for key, one in named.items()
        ]
        config = convert({**table, "sensor": next(iter(named.values()))}, Config, path)
    main, *others = _numbered(sensors, path)
    calibration = config.calibration
    if main.calibration is not None:
        if calibration is not None:
            expected = f"expected one calibration of {main.label}, got this and its own; remove one"
            raise ConfigError(path, "calibration.file", expected)
        calibration = CalibrationFile(file=main.calibration)
    _check_sources(config.telemetry, path)
    return msgspec.structs.replace(
        config, sensor=main, more_sensors=tuple(others), calibration=calibration, path=path
    )


def _check_sources(telemetry: dict[str, Telemetry], path: Path) -> None:
    """Check that no two parameters have the same values; ConfigError: they have."""
    names: dict[str, str] = {}
    for name, one in telemetry.items():
        values = (one.message, one.field, sorted(one.match.items()), one.component, one.scale, one.offset)
        other = names.setdefault(repr(values), name)
        if other != name:
            text = f"expected other values than telemetry.{other}: message, match and field are equal"
            raise ConfigError(path, f"telemetry.{name}", text)


def _named_sensors(sensor: Any) -> dict[str, Any]:
    """Return the tables ``[sensor.NAME]`` by name; empty for a single table ``[sensor]``."""
    if not isinstance(sensor, dict) or sensor.keys() & {"driver", "port"}:
        return {}
    tables = {name: one for name, one in sensor.items() if isinstance(one, dict)}
    return tables if tables.keys() - {"options"} and len(tables) == len(sensor) else {}


def _numbered(sensors: list[Sensor], path: Path) -> list[Sensor]:
    """Assign missing ids and return the sensors in the order of their ids."""
    if len(sensors) > MAX_BRIDGE_SENSORS:
        raise ConfigError(path, "sensor", f"expected at most {MAX_BRIDGE_SENSORS} tables, got {len(sensors)}")
    names = [one.name for one in sensors]
    if len(set(names)) < len(names):
        raise ConfigError(path, "sensor", f"expected another name for each sensor, got {', '.join(names)}")
    ids = [one.id for one in sensors if one.id is not None]
    if len(set(ids)) < len(ids):
        raise ConfigError(path, "sensor", f"expected a different id for each sensor, got {ids}")
    free = iter(sorted(set(range(MAX_BRIDGE_SENSORS)) - set(ids)))
    numbered = [msgspec.structs.replace(one, id=next(free) if one.id is None else one.id) for one in sensors]
    numbered.sort(key=lambda one: one.id or 0)
    if numbered[0].id != 0:
        raise ConfigError(path, "sensor", f"expected a sensor with the id 0, the main sensor, got {ids}")
    return numbered
