"""The report: ``findings.json`` for programs (:mod:`.findings`), ``report.html`` for people (:mod:`.page`).

:mod:`.figures` draws; :mod:`.page` also writes the files.
"""
