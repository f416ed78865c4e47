"""Define the commands that configure, run, replay, simulate and monitor a bridge."""

from __future__ import annotations

import sys
from contextlib import nullcontext
from functools import partial
from math import inf, nan
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

from cyclopts import Parameter, validators

import magbridge as mb
from magbridge.cli import common as cli
from magbridge.errors import WrongUse
from magbridge.files import new_folder
from magbridge.wording import counted

if TYPE_CHECKING:
    from magbridge.bridge.check import ConfigFault


MIN_REPLAY_SPEED = 1e-3
"""Lowest replay speed, as a multiple of real time: a log of one hour then takes six weeks."""


@cli.command("demo [OPTIONS]")
def demo(
    *,
    out: cli.Folder = Path("demo"),
    seed: Annotated[cli.Whole, Parameter(validator=validators.Number(gte=0))] = 1,
    live: bool = False,
    port: Annotated[cli.Whole, Parameter(validator=validators.Number(gte=1, lte=65535))] = 8080,
    show: Annotated[bool, Parameter(negative="--no-show")] = True,
    json: cli.Json = False,
) -> None:
    """Demonstrate calibration and correction on a simulated glider, without hardware, in under a minute.

    The command simulates a small deployment, and fits a calibration to its spirals. It replays the survey
    into the bridge through a pty and a socket, receives the messages as a ground station would, and draws the
    raw, corrected and true field.

    Parameters
    ----------
    out
        The folder to write to.
    seed
        Seed of the random glider.
    live
        Instead, simulate the glider in real time, with its bridge on a pty and a socket, and show it on the
        ground station's page until Ctrl-C.
    port
        With --live: the TCP port of the page.
    show
        With --live: open the page in a browser.
    """
    if live and json:
        raise WrongUse("--json: demo --live runs until Ctrl-C and has no result; leave one of them out")
    notify = partial(print, file=sys.stderr)
    if live:
        from magbridge.monitor.serve import serve
        from sitl.live import MAP, flying

        with new_folder(out), flying(out, seed, notify) as link:
            serve(link, 0, "127.0.0.1", port, grid=out / MAP, show=show)
        return
    from sitl import demo as demonstration

    with new_folder(out):
        result = demonstration.demo(out, seed, notify)
    cli.print_result(result, demonstration.summary(result), json)


@cli.command("run --config bridge.toml [--check [--live] [--json]]")
def run(*, config: Path, check: bool = False, live: bool = False, json: cli.Json = False) -> None:
    """Read the sensor and the autopilot link, and publish the corrected field until stopped.

    magbridge init writes a configuration, magbridge ports shows which device sends on which serial port, and
    magbridge drivers lists the drivers of sensors with their options.

    Parameters
    ----------
    config
        The configuration (bridge.toml).
    check
        Report every fault of the configuration, and exit; without --live, no port is opened.
    live
        With --check, open the ports for 20 s and list which messages arrive at which rate.
    """
    if check:
        _check(config, live=live, json=json)
        return
    if live or json:
        raise WrongUse("--live, --json: expected --check with them; without it the bridge runs until stopped")

    from magbridge.bridge.run import run as attach

    attach(config)


def _check(config: Path, *, live: bool, json: bool) -> None:
    """Print every fault of a configuration, and with `live` the arriving messages."""
    from magbridge.bridge.check import findings

    found, arriving = findings(config), dict[str, Any]()
    errors = sum(one.fatal for one in found)
    if live and not errors:
        faults, arriving = _listen(config, quiet=json)
        found += faults
    faults_of = [{"severity": "error" if one.fatal else "warning", "text": one.text} for one in found]
    cli.complain_all(f"{fault['severity']}: {fault['text']}" for fault in faults_of)
    warnings = counted(len(found) - errors, "warning")
    facts = {"file": str(config), "would_start": not errors, "findings": faults_of, **arriving}
    cli.print_result(facts, "" if errors else f"{config}: the bridge would start, {warnings}", json)
    if errors:
        text = f"{config}: the bridge would not start: {counted(errors, 'error')}, {warnings}"
        raise cli.FailedResult(text, WrongUse.exit_code)


def _listen(config: Path, *, quiet: bool) -> tuple[list[ConfigFault], dict[str, Any]]:
    """Listen on the ports; return the faults, and the received messages for JSON, printed unless `quiet`."""
    from magbridge.bridge.check import LISTEN_TIME_S, LiveCheck
    from magbridge.config import load

    loaded = load(config)
    where = f"{config}: {LISTEN_TIME_S:.0f} s on {loaded.link.url} and {loaded.sensor.port}"
    print(where, file=sys.stderr if quiet else sys.stdout, flush=True)
    check = LiveCheck(loaded, LISTEN_TIME_S)
    check.listen()
    if not quiet:
        for name, rate_hz in check.readings_hz.items():
            print(f"sensor {name}: {rate_hz:.4g} readings/s")
        print(f"{'message':30} {'from':>8} {'Hz':>8} {'needed':>8}")
        for one in check.arrived:
            needed = f"{one.needed_hz:g}" if one.needed_hz else "-"
            print(f"{one.name:30} {one.sender:>8} {one.rate_hz:8.3g} {needed:>8}")
    arrived = [one._asdict() for one in check.arrived]
    return check.faults, {"readings_hz": check.readings_hz, "messages": arrived}


@cli.command("replay FILE... [--config bridge.toml] [OPTIONS]")
def replay(
    *files: Path,
    config: Path | None = None,
    speed: str = "max",
    log: Annotated[Path | None, Parameter(validator=cli.folder_to_write)] = None,
    reading: cli.ReadingOptions = cli.AS_THEY_SAY,
    json: cli.Json = False,
) -> None:
    """Replay logs through the unmodified bridge: sensor bytes through a pty, MAVLink through a socket.

    A bridge publishes its own log again bit for bit, up to the end of a log that was cut. The exit code is 1
    if a message differs. If a log begins after the start of its run, the command reports the number of
    samples with an identical field. Any other log is replayed by an emulated fluxgate and autopilot, and the
    corrected field is compared with the reference field.

    Parameters
    ----------
    files
        The log, or the files of one log in order.
    config
        The configuration (bridge.toml). If not given, a nominal calibration is fitted to all files except the
        last.
    speed
        Replay speed as a multiple of real time, or max: as fast as possible.
    log
        A folder for the log that the bridge writes during the replay.
    reading
        Options for reading logs that a bridge did not write.
    """
    cli.logs_to_read(files, None, config)

    from sitl.replay.run import replay as played
    from sitl.replay.run import summary

    with new_folder(log) if log else nullcontext():
        result = played(files, config, speed_of(speed), log, reading.options)
    cli.print_result(result, summary(result), json)
    if not all(run["identical"] or run["is_cut"] for run in result.get("runs", ())):
        raise cli.FailedResult("the replay published other values than the log holds; see the runs above")


@cli.command("dialect -o DIR")
def dialect(*, output: cli.FolderOutput, json: cli.Json = False) -> None:
    """Write the MAVLink dialect for other programs: XML files and Python modules for pymavlink.

    magbridge.xml defines the common messages and the messages of magbridge; magbridge_ardupilotmega.xml also
    those of ArduPilot. All included XML files are written, too.

    Parameters
    ----------
    output
        The folder to write to; it is created if it does not exist.
    """
    from magbridge.mavlink.definitions import write_definitions

    with new_folder(output):
        files = [str(path) for path in write_definitions(output)]
    cli.print_result({"files": files}, "\n".join(files), json)


@cli.command("monitor [LINK] [OPTIONS]")
def monitor(
    link: str = "udpin:0.0.0.0:14550",
    /,
    *,
    host: str = "127.0.0.1",
    port: Annotated[cli.Whole, Parameter(validator=validators.Number(gte=1, lte=65535))] = 8080,
    baudrate: Annotated[cli.Whole, Parameter(validator=validators.Number(gt=0))] = 57600,
    signing_key: Path | None = None,
    map: Annotated[Path | None, Parameter(name="--map")] = None,  # noqa: A002 - as the other commands name it
    show: bool = False,
) -> None:
    """Serve a web page for the ground station that shows live the MAVLink data of bridges.

    Parameters
    ----------
    link
        The link to the bridge: udpin:HOST:PORT (or [IPV6]:PORT), udpout, tcp, tcpin, or a serial device.
    host
        The address to serve the page at. With 0.0.0.0, other machines can open the page with the token in the
        printed address.
    port
        The TCP port to serve the page at.
    baudrate
        Baud rate of a serial link.
    signing_key
        The bridge's key, a file of 32 bytes: sent messages are signed, and unsigned messages are rejected.
    map
        An anomaly grid to show beneath the track.
    show
        Open the page in a browser.
    """
    from magbridge.mavlink import load_key
    from magbridge.monitor.serve import serve

    key = load_key(signing_key) if signing_key else None
    serve(link, baudrate, host, port, key=key, grid=map, show=show)


def speed_of(text: str) -> float:
    """Return the replay speed over real time, infinite for ``max``; WrongUse: it is not a positive number."""
    try:
        speed = inf if text == "max" else float(text)
    except ValueError:
        speed = nan
    if not speed >= MIN_REPLAY_SPEED:
        raise WrongUse(f"--speed {text}: expected a positive number, {MIN_REPLAY_SPEED:g} or more, or max")
    return speed


@cli.command("init [-o bridge.toml] [OPTIONS]")
def init(
    *,
    output: Annotated[Path, Parameter(name=["--output", "-o"], validator=cli.file_to_write(".toml"))] = Path(
        "bridge.toml"
    ),
    driver: str | None = None,
    port: str | None = None,
    baudrate: Annotated[cli.Whole, Parameter(validator=validators.Number(gt=0, lte=20_000_000))] = 9600,
    link: str | None = None,
    system: Annotated[cli.Whole | None, Parameter(validator=validators.Number(gte=1, lte=255))] = None,
    parameter: tuple[str, ...] = (),
    option: tuple[str, ...] = (),
    calibration: Path | None = None,
    json: cli.Json = False,
) -> None:
    """Write a commented bridge.toml from options, or from the answers to five questions.

    On a terminal the command asks for each value that no option gives: sensor, port, link, system id, moving
    masses.

    Parameters
    ----------
    output
        The configuration to write; an existing file is not overwritten.
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
        Telemetry name and unit of a moving mass, as "battpos [in]"; may be repeated. The masses of a
        calibration need not be named.
    option
        An option of the driver, as sensitivity=5e-5; may be repeated.
    calibration
        The calibration (cal.json) to correct with.
    """
    if output.exists():
        raise WrongUse(f"{output}: exists already and is not overwritten; choose another file with -o")

    from magbridge.bridge.check import findings
    from magbridge.bridge.init import PLACEHOLDER, Answers, bridge_toml
    from magbridge.files import atomic_path
    from magbridge.sensors.options import driver_names

    known = mb.load(calibration) if calibration else None
    asks = not json and sys.stdin.isatty() and sys.stdout.isatty()
    names = f"drivers: {', '.join(driver_names())} (magbridge drivers NAME: its options)"
    driver = driver or _ask("1. Which sensor?", names, "digitizer", asks, "--driver")
    default = "i2c:1:0x20" if driver == "rm3100" else "/dev/ttyUSB*"
    port = port or _ask("2. On which port?", _ports_listed(), default, asks, "--port")
    default = "udpout:127.0.0.1:14550"
    link = link or _ask("3. Where is the autopilot or the ground station?", "", default, asks, "--link")
    number = system or _system(_ask("4. The vehicle's system id?", "", "1", asks, "--system"))
    if not parameter and known is None and asks:
        hint = "as: battpos [in], ballast [cm3]; none: press Enter"
        masses = _ask("5. Which masses move?", hint, "", asks, "").split(",")
        parameter = tuple(name.strip() for name in masses if name.strip())
    options, file = _options(option, driver), _relative(calibration, output)
    answers = Answers(driver, port, baudrate, link, number, parameter, options, file)
    text = bridge_toml(answers, known)
    with atomic_path(output) as path:
        path.write_text(text, encoding="utf-8")
        fatal = [one.text for one in findings(path) if one.fatal]
        if fatal and PLACEHOLDER not in text:  # the user still has to fill in a setting
            raise WrongUse(f"{fatal[0].replace(str(path), str(output))}: nothing is written")
    found = [one.text for one in findings(output)]
    cli.complain_all(found)
    sentence = f"written; next: magbridge run --check --config {output}"
    cli.print_result({"findings": found}, sentence, json, output)


def _relative(file: Path | None, output: Path) -> str | None:
    """Return the path of `file`, relative to the folder of `output` if it is inside, else absolute."""
    if file is None:
        return None
    file, folder = file.absolute(), output.absolute().parent
    return str(file.relative_to(folder) if file.is_relative_to(folder) else file)


def _ask(question: str, hint: str, default: str, asks: bool, flag: str) -> str:
    if not asks:
        if not default:
            raise WrongUse(f"expected {flag}, which is asked for on a terminal only")
        return default
    if hint:
        print(hint)
    try:
        answer = input(f"{question} [{default}] " if default else f"{question} ").strip()
    except EOFError:
        raise WrongUse(
            f"{question} expected an answer, got the end of the input; nothing is written"
        ) from None
    return answer or default


def _system(answer: str) -> int:
    if not (answer.isdecimal() and 1 <= int(answer) <= 255):
        raise WrongUse(f"system id: expected a number from 1 to 255, got {answer!r}; nothing is written")
    return int(answer)


def _ports_listed() -> str:
    from magbridge.bridge.ports import ports as there

    found = [f"  {one.device}  {one.description}" for one in there()]
    return "\n".join(["ports of this computer:", *found]) if found else "no serial port is there now"


def _options(texts: tuple[str, ...], driver: str) -> dict[str, Any]:
    """Return the driver's options (name -> value) from NAME=VALUE; WrongUse: the driver lacks an option."""
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
        raise WrongUse(f"--option {text}: expected NAME=VALUE, such as sensitivity=5e-5")
    try:
        return name.strip(), tomllib.loads(f"value = {value.strip()}")["value"]
    except tomllib.TOMLDecodeError:
        return name.strip(), value.strip()  # a word without quotes


@cli.command("ports [PORT...] [OPTIONS]")
def ports(
    *names: str,
    baudrate: tuple[int, ...] = (),
    seconds: Annotated[float, Parameter(validator=validators.Number(gt=0, lte=600))] = 1.5,
    json: cli.Json = False,
) -> None:
    """Listen on serial ports, and show which device sends on each.

    The command recognises sensors, autopilots and GPS receivers, and shows a line that it cannot parse. It
    sends nothing, so it does not recognise a sensor that waits for a request. The exit code is 1 if a named
    port cannot be opened.

    Parameters
    ----------
    names
        The ports to listen on: devices or pyserial URLs. By default all ports of this computer.
    baudrate
        A baud rate to listen at; may be repeated. By default the usual rates, until a device is recognised.
    seconds
        Listening time at each baud rate, in s.
    """
    from magbridge.bridge.ports import BAUDRATES, Recognised, SerialDevice, listen
    from magbridge.bridge.ports import ports as there
    from magbridge.errors import PortError
    from magbridge.progress import track

    asked = [SerialDevice(name, "") for name in names] or there()
    found, closed = [], []
    for port in track(asked, "listening", len(asked)):
        try:
            recognised, at, _ = listen(port.device, baudrate or BAUDRATES, seconds)
        except PortError as error:
            recognised, at = Recognised("", error.reason), None
            closed.append(port.device)
        one = {"device": port.description, "who": recognised.who, "said": recognised.text, "baudrate": at}
        found.append({"port": port.device, **one})
        if not json:
            speed = f" at {at} bit/s" if at and recognised.who else ""
            about = f" ({port.description})" if port.description else ""
            print(f"{port.device}{about}: {recognised.text}{speed}")
    cli.print_result({"ports": found}, "" if asked else "no serial port is there", json)
    if names and closed:
        raise cli.FailedResult(f"not listened to: {', '.join(closed)}")


@cli.command("drivers [NAME] [OPTIONS]")
def drivers(name: str | None = None, /, *, json: cli.Json = False) -> None:
    """List the sensor drivers and their options, which belong into [sensor.options] of a bridge.toml.

    Parameters
    ----------
    name
        The only driver to list; by default all drivers.
    """
    from magbridge.sensors.options import driver_names, options_of

    facts: dict[str, list[dict[str, Any]]] = {}
    lines = []
    for driver in [name] if name else driver_names():
        lines.append(f"{driver}:")
        facts[driver] = []
        for one in options_of(driver):
            meaning = one.meaning.replace("``", "")
            option = {"name": one.name, "type": one.kind, "required": one.required, "meaning": meaning}
            facts[driver].append(option if one.required else option | {"default": one.default})
            default = "required" if one.required else f"default {one.default!r}"
            lines.append(f"  {one.name} ({one.kind}; {default}): {meaning}")
    cli.print_result(facts, "\n".join(lines), json)
