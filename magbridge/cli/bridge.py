"""Commands that run the bridge, or listen to it: demo, run, replay, monitor."""

from __future__ import annotations

import sys
from contextlib import nullcontext
from math import inf, nan
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

from cyclopts import Parameter, validators

from magbridge.cli.common import (
    AS_THEY_SAY,
    FailedResult,
    Folder,
    Json,
    ReadingOptions,
    Whole,
    command,
    complain,
    folder_to_write,
    logs_to_read,
    print_result,
)
from magbridge.errors import WrongUse
from magbridge.files import new_folder
from magbridge.wording import counted

if TYPE_CHECKING:
    from magbridge.bridge.check import ConfigFault

MIN_REPLAY_SPEED = 1e-3
"""Lowest replay speed, relative to real time: a log of an hour then takes six weeks."""


@command("demo [OPTIONS]")
def demo(
    *,
    out: Folder = Path("demo"),
    seed: Annotated[Whole, Parameter(validator=validators.Number(gte=0))] = 1,
    live: bool = False,
    port: Annotated[Whole, Parameter(validator=validators.Number(gte=1, lte=65535))] = 8080,
    show: Annotated[bool, Parameter(negative="--no-show")] = True,
    json: Json = False,
) -> None:
    """Do the main job end to end on a simulated glider: no hardware, no network, under a minute.

    Simulates a small deployment, fits a calibration to its spirals, replays the survey into the
    bridge through a pty and a socket, listens as a ground station would, and draws the raw, corrected
    and true field.

    Parameters
    ----------
    out
        The folder to write to.
    seed
        Which random glider.
    live
        Fly the glider in real time instead, with its bridge on a pty and a socket, and show it in the ground
        station's page until Ctrl-C.
    port
        With --live, the port to serve the page at.
    show
        With --live, open the page in a browser.
    """
    if live:
        if json:
            raise WrongUse("--json: demo --live runs until Ctrl-C and has no result; leave one of them out")
        _live(out, seed, port, show=show)
        return
    from sitl import demo as demonstration

    with new_folder(out):
        result = demonstration.demo(out, seed, notify=lambda text: print(text, file=sys.stderr))
    print_result(result, demonstration.summary(result), json)


def _live(folder: Path, seed: int, port: int, *, show: bool) -> None:
    """Fly the demonstration's glider into the page until interrupted."""
    from magbridge.monitor.serve import serve
    from sitl.live import MAP, flying

    def notify(text: str) -> None:
        print(text, file=sys.stderr)

    with new_folder(folder):
        folder.mkdir(parents=True, exist_ok=True)
        with flying(folder, seed, notify) as link:
            serve(link, 0, "127.0.0.1", port, grid=folder / MAP, show=show)


@command("run --config bridge.toml [--check [--live] [--json]]")
def run(*, config: Path, check: bool = False, live: bool = False, json: Json = False) -> None:
    """Attach to the sensor and the autopilot link, and publish the corrected field until stopped.

    magbridge init writes a configuration, magbridge ports shows which device sends on which serial port, and
    magbridge drivers lists the drivers of sensors with their options.

    Parameters
    ----------
    config
        The configuration (bridge.toml).
    check
        Report everything that would go wrong, and exit; without --live, no port is opened.
    live
        With --check, open the ports for 20 s and list which messages arrive at which rate.
    """
    if check:
        _check(config, live=live, json=json)
        return
    if live or json:
        raise WrongUse("run: --live and --json go with --check")

    from magbridge.bridge.run import run as attach

    if sys.stderr.isatty():
        print(f"{config}: running until Ctrl-C; announcements on the link are repeated here", file=sys.stderr)
    attach(config)


def _check(config: Path, *, live: bool, json: bool) -> None:
    """Print all that would go wrong, and with `live` what arrives; WrongUse: the bridge would not start."""
    from magbridge.bridge.check import findings
    from magbridge.toml import load_toml

    load_toml(config)  # a file that cannot be read is an error of its own
    found, arriving = findings(config), dict[str, Any]()
    errors = sum(one.fatal for one in found)
    if live and not errors:
        faults, arriving = _listen(config, quiet=json)
        found += faults
    faults_of = [{"severity": "error" if one.fatal else "warning", "text": one.text} for one in found]
    for fault in faults_of:
        complain(f"{fault['severity']}: {fault['text']}")
    warnings = counted(len(found) - errors, "warning")
    facts = {"file": str(config), "would_start": not errors, "findings": faults_of, **arriving}
    print_result(facts, "" if errors else f"{config}: the bridge would start, {warnings}", json)
    if errors:
        raise FailedResult(
            f"{config}: the bridge would not start: {counted(errors, 'error')}, {warnings}",
            WrongUse.exit_code,
        )


def _listen(config: Path, *, quiet: bool) -> tuple[list[ConfigFault], dict[str, Any]]:
    """Listen on the ports; return the faults, and what arrived for JSON; print that unless `quiet`."""
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


@command("replay FILE... [--config bridge.toml] [OPTIONS]")
def replay(
    *files: Path,
    config: Path | None = None,
    speed: str = "max",
    log: Annotated[Path | None, Parameter(validator=folder_to_write)] = None,
    reading: ReadingOptions = AS_THEY_SAY,
    json: Json = False,
) -> None:
    """Replay logs through the unmodified bridge: real bytes through a pty, real MAVLink through a socket.

    A bridge's own log is published again bit for bit. For a log that was restarted in the middle of a run
    (the file was deleted, or the disk was full) it reports in how many samples the field is the same. Any
    other log is played through an emulated fluxgate and an emulated autopilot, and the corrected field is
    compared with the reference field.

    Parameters
    ----------
    files
        The log, or its files in order.
    config
        The configuration (bridge.toml). Without one, a nominal calibration is fitted to all
        files but the last.
    speed
        A multiple of real time, or max: as fast as possible.
    log
        A folder for the log that the bridge writes during the replay.
    reading
        How to read logs that are not a bridge's own.
    """
    logs_to_read(files, None, config)

    from sitl.replay.run import replay as played
    from sitl.replay.summary import summary

    with new_folder(log) if log else nullcontext():
        result = played(files, config, speed_of(speed), log, reading.options)
    print_result(result, summary(result), json)
    if not all(run["identical"] for run in result.get("runs", ())):
        raise FailedResult("the replay did not publish what the log holds")


@command("dialect -o DIR")
def dialect(*, output: Annotated[Folder, Parameter(name=["--output", "-o"])], json: Json = False) -> None:
    """Write the MAVLink dialect for other programs: the XML with all that it includes, modules for pymavlink.

    magbridge.xml holds the common messages and ours; magbridge_ardupilotmega.xml ArduPilot's as well.

    Parameters
    ----------
    output
        The folder to write to; it is made if it does not exist.
    """
    from magbridge.mavlink.definitions import write_definitions

    with new_folder(output):
        files = [str(path) for path in write_definitions(output)]
    print_result({"files": files}, "\n".join(files), json)


@command("monitor [LINK] [OPTIONS]")
def monitor(
    link: str = "udpin:0.0.0.0:14550",
    /,
    *,
    host: str = "127.0.0.1",
    port: Annotated[Whole, Parameter(validator=validators.Number(gte=1, lte=65535))] = 8080,
    baudrate: Annotated[Whole, Parameter(validator=validators.Number(gt=0))] = 57600,
    signing_key: Path | None = None,
    map: Annotated[Path | None, Parameter(name="--map")] = None,  # noqa: A002 - as the other commands name it
    show: bool = False,
) -> None:
    """Serve the ground station's page, which shows live the data and messages that a bridge sends by MAVLink.

    Parameters
    ----------
    link
        The link to the bridge: udpin:HOST:PORT (or [IPV6]:PORT), udpout, tcp, tcpin, or a serial device.
    host
        The address to serve the page at; 0.0.0.0 makes it visible to other machines, to those who have the
        token that is printed with the address.
    port
        The port to serve the page at.
    baudrate
        Baud rate of a serial link.
    signing_key
        The file of 32 bytes that the bridge has: sent messages are signed, and unsigned ones are rejected.
    map
        An anomaly grid to be shown beneath the track.
    show
        Open the page in a browser.
    """
    from magbridge.mavlink import load_key
    from magbridge.monitor.serve import serve

    key = load_key(signing_key) if signing_key else None
    serve(link, baudrate, host, port, key=key, grid=map, show=show)


def speed_of(text: str) -> float:
    """Return a replay speed relative to real time, infinite for ``max``; WrongUse: no positive number."""
    try:
        speed = inf if text == "max" else float(text)
    except ValueError:
        speed = nan
    if not speed >= MIN_REPLAY_SPEED:
        raise WrongUse(f"--speed {text}: expected a positive number, {MIN_REPLAY_SPEED:g} or more, or max")
    return speed
