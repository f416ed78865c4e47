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
- ``fit``: a calibration of these observations, with its covariance, warnings and residual
- ``Calibration``: what a fit found: the model, its coefficients and how sure they are
- ``save``, ``load``: a calibration to and from ``cal.json``
- ``correct``: the field of one reading, or of arrays of them
- ``Corrector``: the same for many readings, one by one
- ``Correction``: readings and telemetry, aligned and corrected as the bridge does it
- ``correct_rows``: a log, corrected: total field, vector, anomaly, sigmas and flags
- ``plot``: pictures: ``corrected``, ``residuals``, ``grid``; each returns matplotlib's axes
- ``MagbridgeError``: what every error is that magbridge raises; its text is one line

:func:`magbridge.diagnose.run.diagnose` and :func:`magbridge.navigate.batch.navigate` go on from there. Each
name is imported when it is first asked for: the bridge itself needs few of them. And since the program begins
here, too, where Ctrl-C would still print a traceback, nothing at all is imported at once.
"""

TYPE_CHECKING = False  # type checkers take it for true
if TYPE_CHECKING:
    from magbridge import plot
    from magbridge.calibration.correct import correct
    from magbridge.calibration.corrector import Corrector
    from magbridge.calibration.file import load, save
    from magbridge.calibration.fitting.fit import fit
    from magbridge.calibration.fitting.observe import observations
    from magbridge.calibration.model import Calibration
    from magbridge.correction import Correction
    from magbridge.errors import MagbridgeError
    from magbridge.field.read import read_grid
    from magbridge.field.reference import reference_field
    from magbridge.logs import read, write
    from magbridge.logs.frames import from_frame, to_frame
    from magbridge.rows import correct_rows
    from magbridge.version import __version__

__all__ = [
    "Calibration", "Correction", "Corrector", "MagbridgeError", "__version__", "correct", "correct_rows",
    "fit", "from_frame", "load", "observations", "plot", "read", "read_grid", "reference_field", "save",
    "to_frame", "write",
]  # fmt: skip

_HOMES = {
    "Calibration": "calibration.model",
    "Correction": "correction",
    "Corrector": "calibration.corrector",
    "MagbridgeError": "errors",
    "__version__": "version",
    "correct": "calibration.correct",
    "correct_rows": "rows",
    "fit": "calibration.fitting.fit",
    "from_frame": "logs.frames",
    "load": "calibration.file",
    "observations": "calibration.fitting.observe",
    "read": "logs",
    "read_grid": "field.read",
    "reference_field": "field.reference",
    "save": "calibration.file",
    "to_frame": "logs.frames",
    "write": "logs",
}


def __getattr__(name: str) -> object:
    if name not in __all__:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    from importlib import import_module  # noqa: PLC0415 - see above

    if name == "plot":
        return import_module(f"{__name__}.plot")
    return getattr(import_module(f"{__name__}.{_HOMES[name]}"), name)


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})
