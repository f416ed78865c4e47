"""Fixtures of the fleet tests: the simulated logs of two vehicles, and their processed catalogue."""

import os
import signal
from pathlib import Path

import pytest
from fleets import FLEET, catalogue_of, fly

from magbridge.fleet.catalogue import FolderCatalogue as Catalogue
from magbridge.fleet.process import client_of, process
from magbridge.fleet.register import Vehicle, add_vehicle, jobs


@pytest.fixture(scope="session")
def flown(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a folder with a fleet.toml and the logs that it lists."""
    folder = tmp_path_factory.mktemp("fleet")
    for vehicle, name, number in ((1, "one/first", 0), (1, "one/second", 1), (2, "two/first", 0)):
        fly(folder / f"{name}.nc", vehicle, number)
    (folder / "fleet.toml").write_text(FLEET)
    return folder


@pytest.fixture(scope="session")
def done(flown: Path, tmp_path_factory: pytest.TempPathFactory) -> Catalogue:
    """Return the fleet's catalogue after two workers processed it, one of which was killed and replaced."""
    catalogue = catalogue_of(tmp_path_factory.mktemp("done"), flown)
    with client_of("", 2, "2 GiB") as client:
        victim = next(iter(client.run(os.getpid).values()))
        for number, failures in enumerate(process(catalogue, jobs(catalogue), client)):
            assert not failures
            if not number:
                os.kill(victim, signal.SIGKILL)
    return catalogue


@pytest.fixture
def catalogue(tmp_path: Path) -> Catalogue:
    """Return a catalogue with one vehicle, comet, and without logs."""
    catalogue = Catalogue(tmp_path / "fleet", create=True)
    add_vehicle(catalogue, "comet", Vehicle(parameters=("battpos",)))
    return catalogue
