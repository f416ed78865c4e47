"""The report: ``findings.json`` for programs, ``report.html`` for people.

:mod:`.files` writes both. :mod:`.page` is the page's first screen, :mod:`.details` the folded parts below it.
:mod:`.figures` draws on :mod:`.canvas`; :mod:`.words` writes names and numbers.
"""
