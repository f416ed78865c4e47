"""A column that moves the field and was not declared is named; one that does not is not."""

from __future__ import annotations

import numpy as np
import pytest
from demos import demo_log

from magbridge.calibration.fitting.fit import fit
from magbridge.calibration.fitting.observe import observations
from magbridge.calibration.fitting.parameter_choice import undeclared


@pytest.mark.parametrize("seed", [2, 5])
@pytest.mark.parametrize("declared", [("battpos",), ("battpos", "ballast")])
def test_a_mass_that_was_left_out_is_named(declared: tuple[str, ...], seed: int) -> None:
    """Also one that nearly always moves with the declared one, as a glider's ballast with its battery."""
    log = demo_log(seed)
    data = observations(log, declared)
    data = data.part(np.arange(len(data)) % 3 == 0)  # as much to see in a third of the time
    rows = np.searchsorted(log["time"].to_numpy(), data.time)
    noise = np.random.default_rng(2).normal(size=len(data))
    others = {name: log[name].to_numpy()[rows] for name in ("ballast", "sensor_temperature")}
    columns = {"noise": noise, "walk": np.cumsum(noise), "clock": data.time, **others}
    others = {name: column for name, column in columns.items() if name not in declared}
    output = undeclared(fit(data, "auto").calibration, data, others)
    if "ballast" in declared:
        assert not output
    else:
        (line,) = output
        assert line.startswith("column 'ballast' is not declared and moves the field, by about ")
        assert line.endswith("--parameter ballast")
