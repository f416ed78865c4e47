"""A fleet of two small vehicles, flown once."""

from __future__ import annotations

import os
import signal
from pathlib import Path

import pytest
from fleets import FLEET, catalogue_of, fly

from magbridge.fleet.catalogue import FolderCatalogue as Catalogue
from magbridge.fleet.process import client_of, process
from magbridge.fleet.register import jobs


@pytest.fixture(scope="session")
def flown(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Folder with a fleet.toml and its logs."""
    folder = tmp_path_factory.mktemp("fleet")
    for vehicle, name, number in ((1, "one/first", 0), (1, "one/second", 1), (2, "two/first", 0)):
        fly(folder / f"{name}.nc", vehicle, number)
    (folder / "fleet.toml").write_text(FLEET)
    return folder


@pytest.fixture(scope="session")
def done(flown: Path, tmp_path_factory: pytest.TempPathFactory) -> Catalogue:
    """The fleet's catalogue, processed by two workers, one of which is killed on the way."""
    catalogue = catalogue_of(tmp_path_factory.mktemp("done"), flown)
    with client_of("", 2, "2 GiB") as client:
        victim = next(iter(client.run(os.getpid).values()))
        for number, failures in enumerate(process(catalogue, jobs(catalogue), client)):
            assert not failures
            if not number:
                os.kill(victim, signal.SIGKILL)
    return catalogue
