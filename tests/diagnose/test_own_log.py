"""A log that the calibration was fitted to, diagnosed all the same."""

from __future__ import annotations

from magbridge.calibration.fitting.fit import fit
from magbridge.calibration.fitting.observe import observations
from magbridge.diagnose.run import diagnose
from sitl import load, simulate
from sitl.dataset import segments


def test_what_a_calibration_learned_from_a_log_does_not_count_twice() -> None:
    """Freed from that, it shows a filter's attenuation in the turns, most of which it has absorbed."""
    ds = segments(simulate(load("demo"), 2))["calibration"]
    calibration = fit(observations(ds, ("battpos", "ballast")), "auto").calibration
    twice, once = (
        {one.hypothesis.candidate.cause for one in diagnose([ds], calibration, learned_from=again).findings}
        for again in ((), (ds,))
    )
    assert "filter_lag" in once - twice
