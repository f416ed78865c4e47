"""A diagnosis on disk."""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from contextlib import ExitStack

from magbridge.calibration.file import encode_calibration
from magbridge.diagnose.causes import CAUSES, Cause
from magbridge.diagnose.diagnosis import Diagnosis
from magbridge.diagnose.report.findings import findings_json
from magbridge.diagnose.report.page import report_html
from magbridge.files import atomic_path, new_folder

__all__ = ["write"]


def write(
    diagnosis: Diagnosis,
    out_dir: str | os.PathLike[str],
    causes: Mapping[str, Cause] = CAUSES,
    remarks: Sequence[str] = (),
) -> None:
    """Write ``findings.json``, ``calibration.json`` and ``report.html``: all three, or none.

    WriteError: one of them cannot be written; what was there before is as it was.
    """
    contents = {
        "calibration.json": encode_calibration(diagnosis.calibration),
        "findings.json": findings_json(diagnosis, causes, remarks),
        "report.html": report_html(diagnosis, causes, remarks).encode(),
    }
    with new_folder(out_dir) as folder, ExitStack() as written:
        for name, content in contents.items():
            written.enter_context(atomic_path(folder / name)).write_bytes(content)
