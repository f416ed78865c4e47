"""magbridge: a magnetometer bridge for vehicles whose own iron moves.

From logs of calibration runs to corrected samples::

    import magbridge as mb

    found = mb.fit(mb.observations(mb.read("runs.nc"), ("battpos", "ballast")))
    mb.save(found.calibration, "cal.json")
    mb.write(mb.correct_rows(mb.Correction(found.calibration), mb.read("survey.nc")), "corrected.nc")

:func:`magbridge.diagnose.run.diagnose` and :func:`magbridge.navigate.batch.navigate` go on from there. Each
name is imported when it is first asked for: the bridge itself needs few of them. And since the program begins
here, too, where Ctrl-C would still print a traceback, nothing at all is imported at once.
"""

TYPE_CHECKING = False  # type checkers take it for true
if TYPE_CHECKING:
    from magbridge.calibration.correct import Corrector, correct
    from magbridge.calibration.file import load, save
    from magbridge.calibration.fitting.fit import fit
    from magbridge.calibration.fitting.observe import observations
    from magbridge.calibration.model import Calibration
    from magbridge.correction import Correction, correct_rows
    from magbridge.errors import MagbridgeError
    from magbridge.field.read import read_grid
    from magbridge.field.reference import reference_field
    from magbridge.logs import read, write
    from magbridge.version import __version__

__all__ = [
    "Calibration",
    "Correction",
    "Corrector",
    "MagbridgeError",
    "__version__",
    "correct",
    "correct_rows",
    "fit",
    "load",
    "observations",
    "read",
    "read_grid",
    "reference_field",
    "save",
    "write",
]

_HOMES = {
    "Calibration": "calibration.model",
    "Correction": "correction",
    "Corrector": "calibration.correct",
    "MagbridgeError": "errors",
    "__version__": "version",
    "correct": "calibration.correct",
    "correct_rows": "correction",
    "fit": "calibration.fitting.fit",
    "load": "calibration.file",
    "observations": "calibration.fitting.observe",
    "read": "logs",
    "read_grid": "field.read",
    "reference_field": "field.reference",
    "save": "calibration.file",
    "write": "logs",
}


def __getattr__(name: str) -> object:
    if name not in _HOMES:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    from importlib import import_module  # noqa: PLC0415 - see above

    return getattr(import_module(f"{__name__}.{_HOMES[name]}"), name)
