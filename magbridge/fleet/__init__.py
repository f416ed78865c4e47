"""Fleets: many vehicles, many logs, one memory.

:mod:`.catalogue` is the catalogue, in a folder of Parquet files (:mod:`.folder`) or in a database
(:mod:`.postgres`); :mod:`.register` puts vehicles and logs there, :mod:`.calibrations` calibrations.
:mod:`.job` is what there is to do, and :mod:`.process` runs :mod:`.work` on each, in parallel.
:mod:`.hierarchy` is the statistics of coefficients over vehicles, refits and power-ups (:mod:`.variances`,
:mod:`.shapes`), :mod:`.learn` teaches it, :mod:`.memory` is a catalogue's, :mod:`.drift` tells what changed
and when, and :mod:`.page` shows it.
"""
