"""Run third-party magnetometer calibrations on a glider's data, for tools/accuracy.py in another interpreter.

magyc (PyPI) needs numpy < 2 and gtsam, MAVProxy needs a desktop. Neither fits magbridge's environment, so::

    python -m venv .venv-peers
    .venv-peers/bin/pip install magyc MAVProxy pymavlink
    python tools/accuracy.py --peers .venv-peers/bin/python

In: an ``.npz`` with raw ``field`` (n, 3) nT, ``reference`` (n,) nT, ``attitude`` (n, 3) deg roll, pitch,
heading, ``rates`` (n, 3) rad/s (both exact, better than any vehicle knows them), ``reference_ned`` (3,) nT,
``time`` (n,) s and, where there is one, a ``current`` (n,) A. Out, on stdout: JSON, for each method (or those
whose name has the second argument in it) ``{"A": 3x3, "T": 3, "K": 3}`` such that the corrected field is
``A (field - T) + K current``, or ``{"failed": reason}``.
"""

from __future__ import annotations

import contextlib
import json
import sys
import types
import warnings
from collections.abc import Callable
from functools import partial
from typing import Any

import numpy as np

NT_PER_MILLIGAUSS = 100.0
MAGFIT_SAMPLES = 250
"""Maximum number of samples for magfit, which is slow; they are evenly spaced, as by its 'Reduce'."""


def magfit(data: dict[str, np.ndarray], *, motors: bool = False) -> np.ndarray:
    """Fit offsets, scale, diagonals and off-diagonals with MAVProxy; return the corrected field (n, 3), nT.

    The fit uses the attitude and the Earth's field, and with `motors` also the battery's current.
    """
    # replace the desktop toolkit, which magfit imports for its window and does not use in the fit
    desktop = types.SimpleNamespace(Dialog=object, Panel=object, Frame=object)
    for name in ("wx_loader", "wx_processguard", "grapher", "multiproc_util"):
        stand_in: Any = types.ModuleType(name)
        stand_in.wx, stand_in.MPDataLogChildTask = desktop, object
        sys.modules[f"MAVProxy.modules.lib.{name}"] = stand_in
    from MAVProxy.modules.lib import magfit as peer  # noqa: PLC0415  after its desktop is replaced
    from pymavlink.rotmat import Vector3  # noqa: PLC0415

    rows = slice(None, None, max(1, len(data["field"]) // MAGFIT_SAMPLES))
    north, east, _ = data["reference_ned"]
    peer.earth_field = Vector3(*(data["reference_ned"] / NT_PER_MILLIGAUSS))
    peer.declination = float(np.degrees(np.arctan2(east, north)))
    peer.margs = {
        "OffsetMax": 1500.0, "ScaleMin": 0.8, "ScaleMax": 1.2, "Elliptical": True, "DiagonalMin": 0.8,
        "DiagonalMax": 1.2, "OffDiagMin": -0.2, "OffDiagMax": 0.2, "CMOT": motors,
        "CMOT NoChange": False, "CMOT Max": 10.0,
    }  # fmt: skip
    fields = [
        types.SimpleNamespace(MagX=x, MagY=y, MagZ=z)
        for x, y, z in (data["field"] / NT_PER_MILLIGAUSS).tolist()
    ]
    attitudes = [types.SimpleNamespace(Roll=r, Pitch=p, Yaw=y) for r, p, y in data["attitude"].tolist()]
    batteries: list[Any] = [None] * len(fields)
    if motors:
        batteries = [types.SimpleNamespace(Curr=ampere) for ampere in data["current"].tolist()]
    peer.data = list(zip(fields[rows], attitudes[rows], batteries[rows], strict=True))
    found = peer.fit_WWW()
    bare = [peer.correct(mag, battery, found) for mag, battery in zip(fields, batteries, strict=True)]
    return np.array([[v.x, v.y, v.z] for v in bare]) * NT_PER_MILLIGAUSS


def _magyc(name: str) -> Callable[[dict[str, np.ndarray]], np.ndarray]:
    def run(data: dict[str, np.ndarray]) -> np.ndarray:
        import magyc  # noqa: PLC0415  magyc may be missing

        gauss = data["field"] * 1e-5
        method = getattr(magyc, name)
        if name.startswith("twostep"):
            found = method(gauss, data["reference_ned"] * 1e-5)
        elif name == "magfactor3":
            north, east, _ = data["reference_ned"]
            west = -float(np.degrees(np.arctan2(east, north)))  # magyc's sign: the opposite is far worse
            found = method(gauss, np.radians(data["attitude"]), west, data["reference_ned"] * 1e-5)
        elif name.startswith("ellipsoid"):
            found = method(gauss)
        else:
            found = method(gauss, data["rates"], data["time"] - data["time"][0])
        corrected = next(
            np.asarray(part) for part in found[1:] if np.shape(part) in {gauss.shape, gauss.T.shape}
        )
        return np.asarray(corrected.T if corrected.shape[0] == 3 else corrected) * 1e5

    return run


METHODS: dict[str, Callable[[dict[str, np.ndarray]], np.ndarray]] = {
    "MAVProxy magfit": magfit,
    "MAVProxy magfit, motors": partial(magfit, motors=True),
    **{
        f"magyc {name}": _magyc(name)
        for name in (
            "magfactor3", "twostep_hi", "twostep_hsi", "ellipsoid_fit", "magyc_ls", "magyc_nls", "magyc_bfg",
        )
    },
}  # fmt: skip
"""Functions that take the data and return the corrected field (n, 3), nT, by name."""


def main() -> None:
    data, wanted = dict(np.load(sys.argv[1])), "".join(sys.argv[2:])
    results: dict[str, Any] = {}
    raw, reference = data["field"], data["reference"]
    current = data.get("current", np.zeros(len(raw)))
    design = np.column_stack([raw, np.ones(len(raw)), np.nan_to_num(current)])
    warnings.simplefilter("ignore")
    for name, method in METHODS.items():
        if wanted not in name or (name.endswith("motors") and not np.any(np.nan_to_num(current))):
            continue
        try:
            with contextlib.redirect_stdout(sys.stderr):
                corrected = method(data)
            if not np.isfinite(corrected).all():
                raise ValueError("its answer is not finite")  # noqa: TRY301
        # any exception of third-party code is a result
        except (Exception, SystemExit) as error:  # noqa: BLE001
            results[name] = {"failed": f"{type(error).__name__}: {error}".splitlines()[0][:120]}
            continue
        affine = np.linalg.lstsq(design, corrected, rcond=None)[0]
        size = np.linalg.norm(design @ affine, axis=1)
        affine *= (size @ reference) / (size @ size)  # most methods estimate no scale, so use the best
        A, b, K = affine[:3].T, affine[3], affine[4]
        results[name] = {"A": A.tolist(), "T": (-np.linalg.pinv(A) @ b).tolist(), "K": K.tolist()}
    json.dump(results, sys.stdout)


if __name__ == "__main__":
    main()
