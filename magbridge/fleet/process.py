"""Find what is new in a catalogue and process it, a deployment a task, on dask.distributed."""

from __future__ import annotations

import logging
from collections.abc import Iterable, Iterator
from concurrent.futures import CancelledError
from contextlib import contextmanager
from itertools import groupby
from typing import NamedTuple

import dask
from distributed import Client, KilledWorker, LocalCluster, as_completed

from magbridge.errors import PortError
from magbridge.fleet.catalogue import Catalogue, Row
from magbridge.fleet.register import current_files, vehicles
from magbridge.fleet.work import Done, Job, work

__all__ = ["Outcome", "client_of", "jobs", "last_attempts", "new_jobs", "process"]

START = "120s"
"""Until processes of this machine are up: they import much, and it may be busy."""
PATIENCE = "20s"
"""Until a scheduler that does not answer is given up."""


class Outcome(NamedTuple):
    """What came of a deployment: rows added, failures in a line each."""

    job: Job
    added: int
    failures: tuple[str, ...]


@contextmanager
def client_of(scheduler: str, workers: int, memory: str) -> Iterator[Client]:
    """Connect to a scheduler, or start workers here.

    Parameters
    ----------
    scheduler : str
        Its address; empty for a cluster of processes on this machine.
    workers : int
        How many processes that has.
    memory : str
        What each may use at most, as ``4 GiB``.

    Raises
    ------
    PortError
        Nothing answers there.
    """
    logging.getLogger("distributed").setLevel(logging.CRITICAL)  # what matters is raised
    if scheduler:
        try:
            client = Client(scheduler, timeout=PATIENCE)
        except (OSError, ValueError, TimeoutError) as error:
            raise PortError(scheduler, f"no dask scheduler answers: {error}") from error
        with client:
            yield client
        return
    with (
        dask.config.set({"distributed.comm.timeouts.connect": START, "distributed.comm.timeouts.tcp": START}),
        LocalCluster(
            n_workers=workers,
            threads_per_worker=1,
            memory_limit=memory,
            dashboard_address=None,
            silence_logs=logging.CRITICAL,
        ) as cluster,
        Client(cluster) as client,
    ):
        yield client


def jobs(catalogue: Catalogue, *, diagnose: bool = False, maps: bool = False) -> list[Job]:
    """Return every deployment of a catalogue as a job, processed or not.

    Parameters
    ----------
    catalogue : Catalogue
        Its files and vehicles.
    diagnose, maps : bool
        Whether each is also to be diagnosed, and mapped.
    """
    known = vehicles(catalogue)

    def whose(row: Row) -> tuple[str, str, str]:
        return row["vehicle"], row["deployment"], row["refit"]

    rows = sorted(current_files(catalogue.rows("files")), key=whose)
    return [
        Job(known[vehicle], deployment, refit, tuple(files), diagnose, maps)
        for (vehicle, deployment, refit), files in groupby(rows, whose)
        if vehicle in known
    ]


def process(catalogue: Catalogue, todo: list[Job], client: Client) -> Iterator[Outcome]:
    """Process deployments; yield what came of each as it is done.

    A task whose worker is lost is given to another; one that is killed leaves nothing but what is done.

    Raises
    ------
    PortError
        The scheduler was lost.
    """
    folder = catalogue.results.resolve()
    futures = {client.submit(work, job, folder, pure=False): job for job in todo}
    for future in as_completed(futures):
        job = futures[future]
        try:
            done = future.result()
        except KilledWorker:
            line = f"{job.vehicle['vehicle']} {job.deployment}: its workers were killed (out of memory?)"
            done = Done({}, line)
        except CancelledError as error:
            address = client.scheduler_info()["address"] if client.scheduler else str(client)
            raise PortError(address, "the dask scheduler was lost: run again to do what is left") from error
        future.release()
        yield _kept(catalogue, job, done)
    catalogue.compact()


def new_jobs(catalogue: Catalogue, every: list[Job], *, retry: bool = False) -> list[Job]:
    """Return the jobs of which the catalogue has no result; with `retry`, also those with failures."""
    done = catalogue.rows("done")
    last = last_attempts(done)
    has = {(row["job"], what) for row in done for what in ("diagnosed", "mapped") if row[what]}
    failed = set[str]()
    if retry:
        rows = catalogue.rows("failures", ["job", "attempt"])
        failed = {row["job"] for row in rows if row["attempt"] == last.get(row["job"])}
    todo = []
    for job in every:
        more = job.name in failed
        wanted = (job.diagnose and (job.name, "diagnosed") not in has) or (
            job.map and (job.name, "mapped") not in has
        )
        if more or wanted or job.name not in last:
            todo.append(job._replace(attempt=last.get(job.name, 1) + more))
    return todo


def last_attempts(done: Iterable[Row]) -> dict[str, int]:
    """Return the last attempt at each job, from the rows of what is done."""
    last: dict[str, int] = {}
    for row in done:
        last[row["job"]] = max(row["attempt"], last.get(row["job"], 0))
    return last


def _kept(catalogue: Catalogue, job: Job, done: Done) -> Outcome:
    """Add a deployment's rows to the catalogue; that it is done comes last."""
    added = sum(catalogue.add(table, rows) for table, rows in done.tables.items())
    if not done.hindrance:
        catalogue.add("done", [{**job.mark, "diagnosed": job.diagnose, "mapped": job.map}])
    lines = [row["line"] for row in done.tables.get("failures", ())]
    return Outcome(job, added, (*lines, *([done.hindrance] if done.hindrance else [])))
