"""Fleets: many vehicles, many logs, one memory.

:mod:`.catalogue` keeps the tables, in a folder of Parquet files or in a database (:mod:`.postgres`);
:mod:`.register` puts vehicles and logs there and lists the jobs, which :mod:`.process` runs in parallel.
:mod:`.hierarchy` is the statistics of coefficients over vehicles, refits and power-ups; :mod:`.learn` applies
it to calibrations and finds what changed and when; :mod:`.memory` is the fleet of a catalogue; :mod:`.page`
shows it.
"""
