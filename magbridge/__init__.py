"""magbridge: a magnetometer bridge for vehicles whose own iron moves.

From logs of calibration runs to corrected samples::

    import magbridge as mb

    found = mb.fit(mb.observations(mb.read("runs.nc"), ("battpos", "ballast")))
    mb.save(found.calibration, "cal.json")
    mb.write(mb.correct_rows(mb.Correction(found.calibration), mb.read("survey.nc")), "corrected.nc")

What there is:

- ``read``: a log, or several, of any format, as an ``xarray.Dataset`` on ``time``
- ``write``: a Dataset as a file, in the format of its suffix
- ``from_frame``: a Dataset from a pandas data frame
- ``to_frame``: a data frame from a Dataset, indexed by moments in UTC
- ``read_grid``: an anomaly grid, of any format
- ``reference_field``: what the total field should be at the places of a log
- ``observations``: what a fit needs of a log, and which of its columns move masses
- ``calibrate``: a calibration of a log, with its scalar magnetometer
- ``fit``: a calibration of these observations, with its covariance, warnings and residual
- ``Calibration``: what a fit found: the model, its coefficients and how sure they are
- ``save``, ``load``: a calibration to and from ``cal.json``
- ``correct``: the field of one reading, of arrays of them, or of a log with its scalar magnetometer
- ``Corrector``: the same for many readings, one by one
- ``Correction``: readings and telemetry, aligned and corrected as the bridge does it
- ``correct_rows``: a log, corrected: total field, vector, anomaly, sigmas and flags
- ``heading``: the heading of corrected vectors, with its standard deviation
- ``plan``: the calibration runs to run next
- ``diagnose``: the errors of the model in logs, their causes, and an extended calibration
- ``survey``: an anomaly map from corrected logs
- ``navigate``: the track that the field and a map give
- ``plot``: plots: ``corrected``, ``residuals``, ``grid``; each returns matplotlib's axes
- ``MagbridgeError``: what every error is that magbridge raises; its text is one line

Functions that take a Dataset accept ``time`` in seconds since 1970 UTC or as ``datetime64``. Each name is
imported when it is first used, because the bridge itself needs few of them.
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
"""Name to the module that has it."""


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
    """Keeps ``survey``, ``navigate`` and ``diagnose`` functions, although packages have the same names.

    The import system binds a package that is imported to its name in the parent.
    """

    def __setattr__(self, name: str, value: object) -> None:
        if not (name in _HOMES and isinstance(value, ModuleType)):
            super().__setattr__(name, value)


sys.modules[__name__].__class__ = _Package
