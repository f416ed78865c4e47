"""The report: ``findings.json`` for programs, ``report.html`` for people.

:mod:`.files` writes both. :mod:`.page` is the page: :mod:`.decision` says whether the extended calibration
may fly, :mod:`.found` what was found and :mod:`.doubts` what speaks against it, :mod:`.remaining` what is
left, and :mod:`.limits` what is not known. :mod:`.figures` and :mod:`.figures_of_causes` draw on
:mod:`.canvas`; :mod:`.words` writes names and numbers, :mod:`.glossary` explains them.
"""
