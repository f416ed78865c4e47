"""A diagnosis on disk."""

from __future__ import annotations

import os
from collections.abc import Mapping
from pathlib import Path

from magbridge.calibration.file import save
from magbridge.diagnose.causes import CAUSES, Cause
from magbridge.diagnose.diagnosis import Diagnosis
from magbridge.diagnose.report.findings import findings_json
from magbridge.diagnose.report.page import report_html
from magbridge.files import atomic_path

__all__ = ["write"]


def write(
    diagnosis: Diagnosis, out_dir: str | os.PathLike[str], causes: Mapping[str, Cause] = CAUSES
) -> None:
    """Write ``findings.json``, ``calibration.json`` and ``report.html``: all three, or none.

    Raises
    ------
    WriteError
        One of them cannot be written; what was there before is as it was.
    """
    folder = Path(out_dir)
    folder.mkdir(parents=True, exist_ok=True)
    with (
        atomic_path(folder / "calibration.json") as extended,
        atomic_path(folder / "findings.json") as found,
        atomic_path(folder / "report.html") as report,
    ):
        save(diagnosis.calibration, extended)
        found.write_bytes(findings_json(diagnosis, causes))
        report.write_text(report_html(diagnosis, causes), encoding="utf-8")
