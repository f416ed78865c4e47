"""Process deployments of a catalogue, each a task, on dask.distributed."""

from __future__ import annotations

import logging
from collections.abc import Iterator
from concurrent.futures import CancelledError
from contextlib import contextmanager
from typing import NamedTuple

import dask
from distributed import Client, KilledWorker, LocalCluster, as_completed

from magbridge.errors import PortError
from magbridge.fleet.catalogue import Catalogue
from magbridge.fleet.job import Job
from magbridge.fleet.work import Done, work

__all__ = ["Outcome", "client_of", "process"]

START = "120s"
"""Until processes of this machine are up: they import much, and it may be busy."""
PACE = 64
"""Deployments after which the catalogue is rearranged."""
SCHEDULER_TIMEOUT = "20s"
"""Until a scheduler that does not answer is given up."""


class Outcome(NamedTuple):
    """Result of a deployment: rows added, failures in a line each."""

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
    for name in ("distributed", "distributed.client"):  # what matters is raised
        logging.getLogger(name).setLevel(logging.CRITICAL)
    if scheduler:
        try:
            client = Client(scheduler, timeout=SCHEDULER_TIMEOUT)
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
            dashboard_address="127.0.0.1:0",  # any free port: a second command is no reason to warn
            silence_logs=logging.CRITICAL,
        ) as cluster,
        Client(cluster) as client,
    ):
        yield client


def process(catalogue: Catalogue, todo: list[Job], client: Client) -> Iterator[Outcome]:
    """Process deployments; yield each result as it is finished.

    A task whose worker is lost is given to another; one that is killed leaves nothing but finished work.

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
            line = f"{job.vehicle['vehicle']} {job.deployment}: its workers were killed (out of memory?)"
            done = Done({}, line)
        except CancelledError as error:
            raise PortError(address, "the dask scheduler was lost: run again to do the rest") from error
        future.release()
        yield _kept(catalogue, job, done)
        if number % PACE == 0 or number == len(futures):
            catalogue.compact()


def _kept(catalogue: Catalogue, job: Job, done: Done) -> Outcome:
    """Add a deployment's rows to the catalogue; that it is done comes last."""
    added = sum(catalogue.add(table, rows) for table, rows in done.tables.items())
    if not done.hindrance:
        catalogue.add("done", [{**job.mark, "diagnosed": job.diagnose, "mapped": job.map}])
    lines = [row["line"] for row in done.tables.get("failures", ())]
    return Outcome(job, added, (*lines, *([done.hindrance] if done.hindrance else [])))
