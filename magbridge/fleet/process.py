"""Process the deployments of a catalogue in parallel, each as a task of dask.distributed.

A worker (:func:`work`) writes only corrected logs and maps; the calling process writes the rows of the
catalogue. If a log is faulty, a failure is recorded and the other logs of the deployment are processed. A
temporary fault (a missing or changed file, a full disk) is reported but not recorded: the next call retries.
"""

from __future__ import annotations

import logging
from collections import defaultdict
from collections.abc import Iterator
from concurrent.futures import CancelledError
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

import dask
import numpy as np
import xarray as xr
from dask.utils import parse_bytes
from distributed import Client, KilledWorker, LocalCluster, as_completed
from threadpoolctl import threadpool_limits

from magbridge.calibration.file import encode_calibration
from magbridge.calibration.fitting.fit import Fit, fit
from magbridge.calibration.fitting.observe import observations
from magbridge.calibration.model import Calibration
from magbridge.columns import CHANNELS, counts_from_boot, require
from magbridge.correction import Correction
from magbridge.diagnose.run import diagnose
from magbridge.errors import DataError, FormatError, MagbridgeError, PortError, WriteError, WrongUse
from magbridge.files import digest
from magbridge.fleet.catalogue import Catalogue, Row
from magbridge.fleet.learn import packed
from magbridge.fleet.register import Job
from magbridge.logs import Writer, read
from magbridge.logs.deployment import join, sliced
from magbridge.logs.info import info
from magbridge.records import Quality
from magbridge.rows import correct_rows
from magbridge.survey.maps import anomaly_map
from magbridge.survey.run import samples_of, survey

PIECE_ROWS = 20_000
"""Number of rows of a log that are corrected and written at a time."""


class Done(NamedTuple):
    """Result of a job: rows by table, or the temporary fault that prevented the job (else empty)."""

    tables: dict[str, list[Row]]
    hindrance: str = ""


def work(job: Job, results: Path) -> Done:
    """Process a deployment as its job requests; write corrected logs and maps to the folder `results`."""
    tables: dict[str, list[Row]] = defaultdict(list)
    try:
        with threadpool_limits(1, "blas"):
            _deployment(job, results, tables)
    except (WriteError, OSError, MemoryError) as error:
        return Done({}, f"{_named(job)}: {error}")
    except MagbridgeError as error:
        tables["failures"].append(_failure(job, str(error)))
    return Done(tables)


def _deployment(job: Job, results: Path, tables: dict[str, list[Row]]) -> None:
    """Process a job step by step, and add the rows of each completed step to `tables`."""
    logs: dict[str, xr.Dataset] = {}
    for row in {row["sha256"]: row for row in job.files}.values():
        path = Path(row["path"])
        if digest(path) != row["sha256"]:
            raise OSError(f"{path} has changed since it was catalogued: add it again")
        try:
            logs[row["sha256"]] = log = _checked(path, job)
        except MagbridgeError as error:
            tables["failures"].append(_failure(job, str(error)))
            continue
        tables["logs"].append(_log(log, row["sha256"]))
        if sensor := str(log.attrs.get("sensor", "")) or job.sensor:
            one = {"sensor": sensor, "vehicle": job.vehicle["vehicle"], "deployment": job.deployment}
            tables["sensors"].append(one)
    if not logs:
        raise DataError("none of its logs can be used, for the reasons above")
    together = join(list(logs.values()))
    require(together, (*CHANNELS, *job.vehicle["parameters"]))
    data = observations(together, tuple(job.vehicle["parameters"]))
    inputs = {Path(row["path"]).name: row["sha256"] for row in job.files if row["sha256"] in logs}
    found = fit(replace(data, inputs=inputs), order=job.vehicle["order"])
    start = float(together["time"][0])
    tables["calibrations"] = [_calibration(job, found, start)]
    folder = results / job.vehicle["vehicle"] / job.deployment
    stems = {row["sha256"]: Path(row["path"]).stem for row in job.files}
    for sha, log in logs.items():
        path = folder / f"{stems[sha]}-{sha[:8]}.nc"
        row = _correct(job, found.calibration, log, path)
        tables["corrected"].append({**row, "sha256": sha, "path": path.relative_to(results).as_posix()})
    if job.diagnose:
        tables["findings"], tables["improvements"] = _findings(job, together, found.calibration)
    if job.map:
        path = folder / f"map-{job.name[:8]}.nc"
        row = _map(job, list(logs.values()), found.calibration, path)
        tables["maps"] = [{**row, "path": path.relative_to(results).as_posix()}]


def _checked(path: Path, job: Job) -> xr.Dataset:
    """Read a log; FormatError: the log has no date, or is of another sensor than the job's."""
    log = read(path, required=CHANNELS)
    if counts_from_boot(log):
        first = str(np.datetime64(int(log["time"][0]), "s"))
        raise FormatError(path, f"expected a date, got {first}; give it one with magbridge convert --date")
    sensor, expected = str(log.attrs.get("sensor", "")), job.sensor
    if "" not in (sensor, expected) and sensor != expected:
        wanted = f"expected a log of sensor {expected!r}, which {_named(job)} carries"
        raise FormatError(path, f"{wanted}, got {sensor!r}")
    return log


def _log(log: xr.Dataset, sha: str) -> Row:
    facts = info(log)
    middle = {
        name: float(np.nanmedian(log[name])) if name in log and log[name].notnull().any() else None
        for name in ("latitude", "longitude")
    }
    return {
        "sha256": sha, **{name: facts[name] for name in ("start", "end", "rows", "gaps")},
        "samples": int(log[list(CHANNELS)].to_array().notnull().all("variable").sum()),
        "losses": sum(facts["skipped"].values()), "sensor": str(log.attrs.get("sensor", "")), **middle,
    }  # fmt: skip


def _calibration(job: Job, found: Fit, start: float) -> Row:
    calibration = found.calibration
    return {
        **job.mark, "vehicle": job.vehicle["vehicle"], "deployment": job.deployment, "refit": job.refit,
        "start": start, "sensor": calibration.sensor.name or job.sensor, "method": calibration.method,
        "rms": found.rms, "noise": calibration.noise.sensor,
        "expected": found.details["expected_over_noise"] * calibration.noise.sensor,
        "supported": found.supported, "warnings": [warning.text for warning in found.warnings],
        "calibration": encode_calibration(calibration).decode(),
        **packed(found.information),
    }  # fmt: skip


def _correct(job: Job, calibration: Calibration, log: xr.Dataset, path: Path) -> Row:
    """Correct a log, write the result to `path`, and return the row for the table ``corrected``."""
    path.parent.mkdir(parents=True, exist_ok=True)
    correction = Correction(calibration)
    samples, flagged, variances = 0, 0, 0.0
    with Writer(path) as writer:
        for piece in sliced(log, PIECE_ROWS):
            fixed = correct_rows(correction, piece)
            writer.append(fixed)
            doubtful = fixed["quality"].to_numpy().astype(int) & ~int(Quality.NO_BORESIGHT) != 0
            sigma = fixed["total_field_sigma"].to_numpy()
            good = ~doubtful & np.isfinite(sigma)
            samples, flagged = samples + len(sigma), flagged + int(doubtful.sum())
            variances += float((sigma[good] ** 2).sum())
    typical = float(np.sqrt(variances / max(samples - flagged, 1)))
    return {**job.mark, "samples": samples, "flagged": flagged, "sigma": typical}


def _findings(job: Job, log: xr.Dataset, calibration: Calibration) -> tuple[list[Row], list[Row]]:
    """Diagnose a deployment; return its ``findings`` (an empty cause if none) and ``improvements``."""
    found = diagnose([log], calibration, training_logs=[log]).diagnosis
    nothing: Row = {**job.mark, "verdict": found.verdict}
    if not found.findings:
        return [{**nothing, "cause": "", "channel": "", "signal_to_noise": None}], []
    rows, improvements = [], []
    for one in found.findings:
        name = {"cause": one.candidate.cause, "channel": one.candidate.channel or ""}
        rows.append({**nothing, **name, "signal_to_noise": one.signal_to_noise})
        low, high = one.improvement.interval
        improvements.append({**job.mark, **name, "ratio": one.improvement.ratio, "low": low, "high": high})
    return rows, improvements


def _map(job: Job, logs: list[xr.Dataset], calibration: Calibration, path: Path) -> Row:
    """Write the anomaly map of a deployment to `path`, and return the row for the table ``maps``."""
    made = survey(samples_of(logs, [calibration]))
    grid = anomaly_map(made.gridded, made.samples, name=path.name)
    grid.save(path)
    rms = float(np.sqrt(np.mean(made.residual**2)))
    return {**job.mark, "rms": rms, "sigma": float(np.nanmedian(grid.sigma))}


def _failure(job: Job, line: str) -> Row:
    whole = " ".join((line if line.startswith("/") else f"{_named(job)}: {line}").split())
    return {**job.mark, "vehicle": job.vehicle["vehicle"], "deployment": job.deployment, "line": whole}


def _named(job: Job) -> str:
    return f"{job.vehicle['vehicle']} {job.deployment}"


WORKER_START_TIMEOUT = "120s"
"""Longest time for the start of local worker processes, which is slow on a busy machine."""
COMPACT_INTERVAL = 64
"""Number of processed deployments after which the catalogue merges its small files."""
SCHEDULER_TIMEOUT = "20s"
"""Longest time to wait for a connection to a scheduler."""
MIN_MEMORY = 100e6
"""Smallest memory of a worker, bytes; with less, none would start."""


@contextmanager
def client_of(scheduler: str, workers: int, memory: str) -> Iterator[Client]:
    """Yield a client of the dask scheduler at an address, or of new local processes if it is empty.

    `workers` is the number of local processes, `memory` the limit of each, such as ``4 GiB``.

    WrongUse: `memory` is not an amount, or less than 100 MB. PortError: the scheduler does not answer.
    """
    try:
        enough = parse_bytes(memory) >= MIN_MEMORY
    except ValueError:
        enough = False
    if not enough:
        raise WrongUse(f'--memory: expected an amount of at least 100 MB, such as "4 GiB", got {memory!r}')
    for name in ("distributed", "distributed.client"):  # faults are raised as errors, too
        logging.getLogger(name).setLevel(logging.CRITICAL)
    if scheduler:
        try:
            client = Client(scheduler, timeout=SCHEDULER_TIMEOUT)
        except (OSError, ValueError, TimeoutError) as error:
            raise PortError(scheduler, f"no dask scheduler answers: {error}") from error
        with client:
            yield client
        return
    timeouts = {"connect": WORKER_START_TIMEOUT, "tcp": WORKER_START_TIMEOUT}
    with (
        dask.config.set({"distributed.comm.timeouts": timeouts}),
        LocalCluster(
            n_workers=workers,
            threads_per_worker=1,
            memory_limit=memory,
            dashboard_address="127.0.0.1:0",  # any free port, so that a second command causes no warning
            silence_logs=logging.CRITICAL,
        ) as cluster,
        Client(cluster) as client,
    ):
        yield client


def process(catalogue: Catalogue, todo: list[Job], client: Client) -> Iterator[list[str]]:
    """Process deployments; after each, yield a list with a line for each of its failures.

    The rows of a deployment are stored as soon as it is finished. If a worker is lost, another worker repeats
    its task.

    PortError: the scheduler was lost.
    """
    folder = catalogue.results.resolve()
    address = str(client.scheduler.address) if client.scheduler else "dask"
    futures = {client.submit(work, job, folder, pure=False): job for job in todo}
    for number, future in enumerate(as_completed(futures), 1):
        job = futures[future]
        try:
            done = future.result()
        except KilledWorker:
            done = Done({}, f"{_named(job)}: its workers were killed (out of memory?)")
        except CancelledError as error:
            text = "the dask scheduler was lost; run magbridge fleet process again to do the rest"
            raise PortError(address, text) from error
        future.release()
        catalogue.add_tables(done.tables)
        lines = [row["line"] for row in done.tables.get("failures", ())]
        if done.hindrance:
            lines.append(done.hindrance)
        else:  # mark the job as done after its rows are stored
            catalogue.add("done", [{**job.mark, "diagnosed": job.diagnose, "mapped": job.map}])
        yield lines
        if number % COMPACT_INTERVAL == 0 or number == len(futures):
            catalogue.compact()
