"""Attach a bridge: write its configuration, find devices on serial ports, and list the drivers' options."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

from cyclopts import Parameter, validators

from magbridge.cli.common import Json, Whole, command, complain, file_to_write, print_result
from magbridge.errors import WrongUse

if TYPE_CHECKING:
    from magbridge.calibration.model import Calibration


@command("init [-o bridge.toml] [OPTIONS]")
def init(
    *,
    output: Annotated[Path, Parameter(name=["--output", "-o"], validator=file_to_write(".toml"))] = Path(
        "bridge.toml"
    ),
    driver: str | None = None,
    port: str | None = None,
    baudrate: Annotated[Whole, Parameter(validator=validators.Number(gt=0, lte=20_000_000))] = 9600,
    link: str | None = None,
    system: Annotated[Whole | None, Parameter(validator=validators.Number(gte=1, lte=255))] = None,
    parameter: tuple[str, ...] = (),
    option: tuple[str, ...] = (),
    calibration: Path | None = None,
    json: Json = False,
) -> None:
    """Write a commented bridge.toml, from five questions or from options.

    On a terminal it asks for each value without an option: sensor, port, link, system id, moving masses.

    Parameters
    ----------
    output
        The configuration to write; one that is there is not overwritten.
    driver
        The sensor's driver; magbridge drivers lists them.
    port
        The sensor's port: a device, a pattern (/dev/ttyUSB*) or a pyserial URL.
    baudrate
        The sensor's baud rate.
    link
        The MAVLink URL, as udpout:192.0.2.1:14550, or a serial device.
    system
        The vehicle's system id.
    parameter
        A moving mass, as "battpos [in]"; may be repeated. Those of a calibration need not be named.
    option
        An option of the driver, as sensitivity=5e-5; may be repeated.
    calibration
        The calibration (cal.json) to correct with.
    """
    if output.exists():
        raise WrongUse(f"{output}: is there already; choose another with -o")

    from magbridge.bridge.check import findings
    from magbridge.bridge.init import PLACEHOLDER, Answers, bridge_toml
    from magbridge.files import atomic_path

    known = _loaded(calibration)
    asks = not json and sys.stdin.isatty() and sys.stdout.isatty()
    driver = driver or _ask("1. Which sensor?", _drivers_help(), "digitizer", asks, "--driver")
    port = port or _ask("2. On which port?", _ports_listed(), "/dev/ttyUSB*", asks, "--port")
    default = "udpout:127.0.0.1:14550"
    link = link or _ask("3. Where is the autopilot or the ground station?", "", default, asks, "--link")
    number = system or _system(_ask("4. The vehicle's system id?", "", "1", asks, "--system"))
    names = parameter
    if not names and known is None and asks:
        hint = "as: battpos [in], ballast [cm3]; none: press Enter"
        names = tuple(name.strip() for name in _ask("5. Which masses move?", hint, "", asks, "").split(","))
        names = tuple(name for name in names if name)
    options, file = _options(option, driver), _relative(calibration, output)
    answers = Answers(driver, port, baudrate, link, number, names, options, file)
    text = bridge_toml(answers, known)
    with atomic_path(output) as path:
        path.write_text(text, encoding="utf-8")
        fatal = [one.text for one in findings(path) if one.fatal]
        if fatal and PLACEHOLDER not in text:  # a setting to fill in is an error only when it is run
            raise WrongUse(f"{fatal[0].replace(str(path), str(output))}: nothing is written")
    found = [one.text for one in findings(output)]
    for finding in found:
        complain(finding)
    sentence = f"{output}: written; next: magbridge run --check --config {output}"
    print_result({"file": str(output), "findings": found}, sentence, json)


def _loaded(calibration: Path | None) -> Calibration | None:
    from magbridge.calibration.file import load

    return load(calibration) if calibration else None


def _relative(file: Path | None, output: Path) -> str | None:
    """Return how `output` is to name a file: paths in it are relative to it."""
    if file is None:
        return None
    file, folder = file.absolute(), output.absolute().parent
    return str(file.relative_to(folder) if file.is_relative_to(folder) else file)


def _ask(question: str, hint: str, default: str, asks: bool, flag: str) -> str:
    if not asks:
        if not default:
            raise WrongUse(f"expected {flag}")
        return default
    if hint:
        print(hint)
    try:
        answer = input(f"{question} [{default}] " if default else f"{question} ").strip()
    except EOFError:
        raise WrongUse("no answer: nothing is written") from None
    return answer or default


def _system(answer: str) -> int:
    if not (answer.isdecimal() and 1 <= int(answer) <= 255):
        raise WrongUse(f"expected a system id from 1 to 255, not {answer!r}: nothing is written")
    return int(answer)


def _drivers_help() -> str:
    from magbridge.sensors.options import driver_names

    return f"drivers: {', '.join(driver_names())} (magbridge drivers NAME: its options)"


def _ports_listed() -> str:
    from magbridge.bridge.ports import ports as there

    found = [f"  {one.device}  {one.description}" for one in there()]
    return "\n".join(["ports of this computer:", *found]) if found else "no serial port is there now"


def _options(texts: tuple[str, ...], driver: str) -> dict[str, Any]:
    """Return the driver's options; WrongUse: the driver has no option of that name."""
    from magbridge.sensors.options import options_of
    from magbridge.wording import one_of

    given, known = dict(map(_option, texts)), [one.name for one in options_of(driver)]
    for name in given:
        if name not in known:
            raise WrongUse(f"--option {name}: {one_of(name, known)}")
    return given


def _option(text: str) -> tuple[str, Any]:
    import tomllib

    name, equals, value = text.partition("=")
    if not equals:
        raise WrongUse(f"--option {text}: expected NAME=VALUE, as sensitivity=5e-5")
    try:
        return name.strip(), tomllib.loads(f"value = {value.strip()}")["value"]
    except tomllib.TOMLDecodeError:
        return name.strip(), value.strip()  # a word without quotes


@command("ports [PORT...] [OPTIONS]")
def ports(
    *names: str,
    baudrate: tuple[int, ...] = (),
    seconds: Annotated[float, Parameter(validator=validators.Number(gt=0, lte=600))] = 1.5,
    json: Json = False,
) -> None:
    """Listen on serial ports, and show which device sends on each.

    It is a sensor, an autopilot, a GPS, or a line that cannot be parsed, which is then shown. Nothing is
    sent: a sensor that waits for a command stays silent here.

    Parameters
    ----------
    names
        The ports to listen on: devices or pyserial URLs; all of this computer's if none is given.
    baudrate
        A baud rate to listen at; may be repeated. If not given: the usual ones, until one is understood.
    seconds
        How long to listen at each baud rate.
    """
    from magbridge.bridge.ports import BAUDRATES, SerialDevice, listen
    from magbridge.bridge.ports import ports as there
    from magbridge.progress import track

    asked = [SerialDevice(name, "") for name in names] or there()
    found = []
    for port in track(asked, "listening", len(asked)):
        recognised, at, _ = listen(port.device, baudrate or BAUDRATES, seconds)
        one = {"device": port.description, "who": recognised.who, "said": recognised.text, "baudrate": at}
        found.append({"port": port.device, **one})
        if not json:
            speed = f" at {at} bit/s" if at and recognised.who else ""
            about = f" ({port.description})" if port.description else ""
            print(f"{port.device}{about}: {recognised.text}{speed}")
    print_result({"ports": found}, "" if asked else "no serial port is there", json)


@command("drivers [NAME] [OPTIONS]")
def drivers(name: str | None = None, /, *, json: Json = False) -> None:
    """List the drivers of sensors, or the options of one, as they stand in [sensor.options] of a bridge.toml.

    Parameters
    ----------
    name
        The driver.
    """
    from magbridge.sensors.options import driver_names, options_of

    facts = {}
    for one in [name] if name else driver_names():
        facts[one] = [
            {"name": o.name, "type": o.kind, "required": o.required, "meaning": o.meaning.replace("``", "")}
            | ({} if o.required else {"default": o.default})
            for o in options_of(one)
        ]
    lines = []
    for one, options in facts.items():
        lines.append(f"{one}:")
        for option in options:
            default = "required" if option["required"] else f"default {option['default']!r}"
            lines.append(f"  {option['name']} ({option['type']}; {default}): {option['meaning']}")
    print_result(facts, "\n".join(lines), json)
