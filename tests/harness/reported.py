"""Render the report of a diagnosis for tests."""

from html import unescape
from unittest.mock import patch

from magbridge.diagnose.assessment import assess
from magbridge.diagnose.diagnosis import Diagnosis
from magbridge.diagnose.report import page
from magbridge.diagnose.report.page import report_html

NO_PICTURES = dict.fromkeys(("measured", "terms", "channels", "spectrum", "track"))
"""Empty figures of the report, because drawing them takes a second."""


def page_of(diagnosis: Diagnosis, *, drawn: bool = False) -> str:
    """Return the HTML report of a diagnosis, with its figures only if `drawn`."""
    if drawn:
        return report_html(assess(diagnosis))
    with patch.object(page, "_pictures", return_value=NO_PICTURES):
        return report_html(assess(diagnosis))


def section(diagnosis: Diagnosis, title: str) -> str:
    """Return the section `title` of the report, with entities resolved and no-break spaces replaced."""
    part = page_of(diagnosis).partition(f"<h2>{title}")[2].partition("<h2>")[0]
    return unescape(part).replace("\N{NO-BREAK SPACE}", " ")
