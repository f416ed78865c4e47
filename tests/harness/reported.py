"""A diagnosis as its report shows it."""

from __future__ import annotations

from html import unescape

from magbridge.diagnose.assessment import assess
from magbridge.diagnose.diagnosis import Diagnosis
from magbridge.diagnose.report.page import report_html

__all__ = ["page_of", "section"]


def page_of(diagnosis: Diagnosis) -> str:
    """The page of a diagnosis."""
    return report_html(assess(diagnosis))


def section(diagnosis: Diagnosis, title: str) -> str:
    """One folded part of the page, its entities resolved and its spaces plain."""
    part = page_of(diagnosis).partition(f"<h2>{title}")[2].partition("<h2>")[0]
    return unescape(part).replace("\N{NO-BREAK SPACE}", " ")
