"""The report: ``findings.json`` for programs (:mod:`.findings`), ``report.html`` for people (:mod:`.page`).

:mod:`.figures` draws the plots. :mod:`.page` also writes all files.
"""
