"""The report: ``findings.json`` for programs, ``report.html`` for people.

:mod:`.files` writes both. :mod:`.page` is the page, :mod:`.found` its section on the causes, :mod:`.doubts`
what speaks against them, :mod:`.figures` its pictures; :mod:`.words` writes names and numbers.
"""
