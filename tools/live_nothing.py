"""How good a bridge gets that begins without a calibration: error and sigma against hours, and the figure.

Random gliders survey a crustal field of 60 nT in a criss-cross, with the IGRF as the only reference and no
calibration run. Printed and drawn: the RMS error about its mean of the published field over the noise
floor, in each stretch of the survey, and its claimed sigma, with and without the error of the level, which
is not observable; and the standardised error of its samples, level and all.

    python tools/live_nothing.py --seeds 4 --hours 24 -o docs/figures/learning.png
"""

from __future__ import annotations

from itertools import pairwise
from pathlib import Path

import live
import numpy as np
from live_changes import MASSES
from live_changes import hours as hours_of
from rich.console import Console
from studies import command_line, table

from magbridge.calibration.model import Parameter
from magbridge.estimation.residual import rms
from magbridge.learning import Learner
from magbridge.learning.start import class_prior

EDGES = (0.05, 0.1, 0.2, 0.35, 0.6, 1.0, 1.5, 2.25, 3.0, 4.5, 6.0, 9.0, 12.0, 18.0, 24.0)
"""Ends of the stretches, h."""
FLOOR = 1.0
"""nT, the noise of the simulated sensor's channels."""


def run(seed: int, hours: float) -> np.ndarray:
    """Return, of each stretch, error about its mean, mean error and claimed sigma, nT; error over sigma."""
    log = live.sampled(live.fly("nothing", seed, hours)[1])
    parameters = []
    for name in MASSES:
        low, high = float(log[name].min()), float(log[name].max())
        parameters.append(Parameter(name, "", low, high, 0.5 * (low + high), 0.5 * (high - low)))
    prior = class_prior(tuple(parameters))
    seen = live.learn(Learner(prior), prior, log)
    time, error = hours_of(log), seen.total - log["truth_total_field"].to_numpy()
    rest = live.at_rest(seen.quality)
    rows = np.full((len(EDGES) - 1, 4), np.nan)
    for row, low, high in zip(rows, EDGES[:-1], EDGES[1:], strict=True):
        here = rest & (time >= low) & (time < high)
        if here.sum() > 10:
            std, mean = np.std(error[here]), np.mean(error[here])
            row[:] = std, mean, np.median(seen.sigma[here]), rms((error / seen.sigma)[here])
    return rows


def draw(results: np.ndarray, file: Path) -> None:
    """Draw error and sigma (seeds, stretches, 4) against hours."""
    import matplotlib.pyplot as plt  # noqa: PLC0415 - only here

    flown = np.isfinite(results[:, :, 0]).any(0)
    results, middle = results[:, flown], np.sqrt(np.array(EDGES[:-1]) * np.array(EDGES[1:]))[flown]
    figure, axes = plt.subplots(figsize=(7.0, 4.0), constrained_layout=True)
    for one in results:
        axes.plot(middle, one[:, 0], color="tab:blue", alpha=0.35, lw=1)
        axes.plot(middle, np.abs(one[:, 1]), color="tab:orange", alpha=0.35, lw=1)
    axes.plot(middle, np.nanmedian(results[:, :, 0], 0), "o-", color="tab:blue", label="error about the mean")
    level = np.nanmedian(np.abs(results[:, :, 1]), 0)
    axes.plot(middle, level, "s-", color="tab:orange", label="error of the level")
    axes.plot(middle, np.nanmedian(results[:, :, 2], 0), "k--", label="claimed sigma, of both")
    axes.axhline(FLOOR, color="0.5", lw=1, label="noise of the sensor")
    axes.set(xscale="log", yscale="log", xlabel="hours since the start", ylabel="nT")
    axes.set_xticks([0.1, 0.3, 1, 3, 6, 12, 24], ["0.1", "0.3", "1", "3", "6", "12", "24"])
    axes.grid(alpha=0.3)
    figure.legend(loc="outside lower center", ncols=2, frameon=False)
    figure.savefig(file)


def main() -> None:
    """Run, print and draw."""
    parser = command_line(__doc__)
    parser.add_argument("--seeds", type=int, default=4, help="gliders")
    parser.add_argument("--first", type=int, default=0, help="the first glider")
    parser.add_argument("--hours", type=float, default=24.0, help="of the survey")
    parser.add_argument("-o", "--output", type=Path, help="where to draw")
    asked = parser.parse_args()
    results = np.array([run(seed, asked.hours) for seed in range(asked.first, asked.first + asked.seeds)])
    shown = table(
        f"{asked.seeds} gliders", "hours", "about the mean", "worst", "level", "sigma", "error/sigma", "worst"
    )
    for k, (low, high) in enumerate(pairwise(EDGES)):
        std, mean, sigma, whole = results[:, k].T
        if np.isfinite(std).any():
            shown.add_row(
                f"{low:g} to {high:g}", f"{np.nanmedian(std) / FLOOR:.2f}", f"{np.nanmax(std) / FLOOR:.2f}",
                f"{np.nanmedian(np.abs(mean)):.0f}", f"{np.nanmedian(sigma):.0f}",
                f"{rms(whole):.2f}", f"{whole.max():.2f}",
            )  # fmt: skip
    Console(width=100).print(shown)
    if asked.output is not None:
        draw(results, asked.output)


if __name__ == "__main__":
    main()
