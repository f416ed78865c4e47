"""magbridge: a magnetometer bridge for vehicles whose own iron moves.

From logs of calibration runs to corrected samples::

    import magbridge as mb

    found = mb.fit(mb.observations(mb.read("runs.nc"), ("battpos", "ballast")))
    mb.save(found.calibration, "cal.json")
    mb.write(mb.correct_rows(mb.Correction(found.calibration), mb.read("survey.nc")), "corrected.nc")

Functions and classes:

- ``read``: read one or several logs of any format as an ``xarray.Dataset`` on ``time``
- ``write``: write a Dataset to a file, in the format of the file's suffix
- ``from_frame``: convert a pandas data frame to a Dataset
- ``to_frame``: convert a Dataset to a data frame, indexed by UTC times
- ``read_grid``: read an anomaly grid of any format
- ``reference_field``: compute the expected total field at the positions of a log
- ``observations``: select the data of a log that a fit needs, given the columns that move masses
- ``calibrate``: fit a calibration to a log, including its scalar magnetometer
- ``fit``: fit a calibration to observations, with covariance, warnings and residual
- ``Calibration``: model with its coefficients and their covariance
- ``save``, ``load``: write and read a calibration (``cal.json``)
- ``correct``: correct one reading, arrays of readings, or a log with its scalar magnetometer
- ``Corrector``: correct many readings, one by one
- ``Correction``: align and correct readings and telemetry as the bridge does
- ``correct_rows``: correct a log: total field, vector, anomaly, sigmas and flags
- ``heading``: compute the heading of corrected vectors, with its standard deviation
- ``plan``: choose the next calibration runs
- ``diagnose``: find the errors of the model in logs and their causes, and extend the calibration
- ``survey``: make an anomaly map from corrected logs
- ``navigate``: estimate the track from the field and a map
- ``plot``: draw ``corrected``, ``residuals`` or ``grid``; each returns matplotlib axes
- ``MagbridgeError``: base class of all errors of magbridge; its text is one line

Functions that take a Dataset accept ``time`` in seconds since 1970 UTC or as ``datetime64``. Each name is
imported at its first use, because the bridge itself needs few of them.
"""

import sys
from types import ModuleType

TYPE_CHECKING = False  # type checkers take it for true
if TYPE_CHECKING:
    from magbridge import plot
    from magbridge.api import calibrate, correct, navigate, survey
    from magbridge.calibration.correct import Corrector
    from magbridge.calibration.file import load, save
    from magbridge.calibration.fitting.fit import fit
    from magbridge.calibration.fitting.observe import observations
    from magbridge.calibration.heading import heading
    from magbridge.calibration.model import Calibration
    from magbridge.calibration.planning.plan import flight_plan as plan
    from magbridge.correction import Correction
    from magbridge.diagnose.run import diagnose
    from magbridge.errors import MagbridgeError
    from magbridge.field.read import read_grid
    from magbridge.field.reference import reference_field
    from magbridge.logs import read, write
    from magbridge.logs.deployment import from_frame, to_frame
    from magbridge.rows import correct_rows
    from magbridge.version import __version__

__all__ = [
    "Calibration", "Correction", "Corrector", "MagbridgeError", "__version__", "calibrate", "correct",
    "correct_rows", "diagnose", "fit", "from_frame", "heading", "load", "navigate", "observations", "plan",
    "plot", "read", "read_grid", "reference_field", "save", "survey", "to_frame", "write",
]  # fmt: skip

_HOMES = {
    **dict.fromkeys(["calibrate", "correct", "navigate", "survey"], "api"),
    **dict.fromkeys(["load", "save"], "calibration.file"),
    **dict.fromkeys(["from_frame", "to_frame"], "logs.deployment"),
    **dict.fromkeys(["read", "write"], "logs"),
    "Calibration": "calibration.model",
    "Correction": "correction",
    "Corrector": "calibration.correct",
    "MagbridgeError": "errors",
    "__version__": "version",
    "correct_rows": "rows",
    "diagnose": "diagnose.run",
    "fit": "calibration.fitting.fit",
    "heading": "calibration.heading",
    "observations": "calibration.fitting.observe",
    "plan": "calibration.planning.plan",
    "read_grid": "field.read",
    "reference_field": "field.reference",
}
"""Public name -> module that defines it, relative to ``magbridge``."""


def __getattr__(name: str) -> object:
    if name not in __all__:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    from importlib import import_module  # noqa: PLC0415 - see above

    if name == "plot":
        return import_module(f"{__name__}.plot")
    home = import_module(f"{__name__}.{_HOMES[name]}")
    return home.flight_plan if name == "plan" else getattr(home, name)


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})


class _Package(ModuleType):
    """Module type that keeps ``survey``, ``navigate`` and ``diagnose`` bound to functions.

    Subpackages have the same names, and the import system would bind these names to the subpackages.
    """

    def __setattr__(self, name: str, value: object) -> None:
        if not (name in _HOMES and isinstance(value, ModuleType)):
            super().__setattr__(name, value)


sys.modules[__name__].__class__ = _Package
