"""Dipoles that move: their polynomials, and the vehicle file that says where they are."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from gliders import Gliders

from magbridge.calibration.dipole import Dipole, dipole_tensor
from magbridge.calibration.fitting.fit import fit
from magbridge.calibration.fitting.pose import read_vehicle
from magbridge.calibration.model import Calibration, Noise, Parameter, Reference
from magbridge.errors import CalibrationError, ConfigError


def test_a_dipole_term_is_the_dipole() -> None:
    """Hard iron along the travel is G(r) m to a millionth, and the induced part turns with the field."""
    at, travel, moment = (
        np.array([-0.4, 0.05, 0.1]),
        np.array([0.03, 0.0, 0.01]),
        np.array([900.0, -300.0, 50.0]),
    )
    cal = Calibration(
        parameters=(Parameter("p", "in", -1.0, 1.0, 0.0, 1.0),),
        terms=(Dipole(parameter="p", at=tuple(at), travel=tuple(travel)),),
        coefficients=np.concatenate([moment, [30.0, 20.0, 10.0], np.zeros(3)]),
        covariance=np.zeros((9, 9)),
        noise=Noise(0.0),
        reference=Reference(5e4),
    )
    p = np.linspace(-1, 1, 9)[:, None]
    A, T = cal.matrices(p)
    G = dipole_tensor(at + p * travel) * np.linalg.norm(at) ** 3
    np.testing.assert_allclose(T, G @ moment, atol=2e-3)
    pulled = G * np.array([30.0, 20.0, 10.0]) / 5e4
    np.testing.assert_allclose(A, np.eye(3) - (pulled + np.swapaxes(pulled, 1, 2)) / 2, atol=1e-8)


def test_a_dipole_that_passes_the_sensor_is_refused() -> None:
    with pytest.raises(CalibrationError, match="within three half-travels"):
        Calibration(
            parameters=(Parameter("p", "in", -1.0, 1.0, 0.0, 1.0),),
            terms=(Dipole(parameter="p", at=(0.1, 0.0, 0.0), travel=(0.05, 0.0, 0.0)),),
            coefficients=np.zeros(9),
            covariance=np.zeros((9, 9)),
            noise=Noise(0.0),
            reference=Reference(5e4),
        ).matrices(np.zeros((1, 1)))


def test_vehicle_toml(tmp_path: Path) -> None:
    path = tmp_path / "vehicle.toml"
    path.write_text("[mass.battpos]\nat = [-0.45, 0.0, 0.05]\nat_sigma = 0.05\ntravel = [0.0254, 0.0, 0.0]\n")
    assert read_vehicle(path)["battpos"].at == (-0.45, 0.0, 0.05)
    for text, match in (
        ("[mass.battpos]\nat = [1, 2]\ntravel = [0, 0, 0]", "mass.*at"),
        ("[mass.battpos]\nat = [1.0, 0.0, 0.0]\ntravel = [0.0, 0.0, 0.0]\nweight = 3", "weight"),
        ("[mass", "not TOML"),
    ):
        path.write_text(text)
        with pytest.raises(ConfigError, match=match):
            read_vehicle(path)


def test_a_mass_that_no_parameter_moves_is_refused(glider: Gliders) -> None:
    vehicle = {"fin": {"at": [1.0, 0.0, 0.0], "travel": [0.0, 0.0, 0.1]}}
    with pytest.raises(CalibrationError, match="mass 'fin'"):
        fit(glider(0, 2).runs, vehicle=vehicle)
