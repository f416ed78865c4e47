"""Process the logs of many vehicles, and predict each vehicle's next calibration from all earlier ones.

:mod:`.catalogue` stores the tables, in a folder of Parquet files or in a database (:mod:`.postgres`).
:mod:`.register` adds vehicles and logs to the catalogue and lists the jobs; :mod:`.process` runs the jobs in
parallel. :mod:`.hierarchy` models how coefficients vary between vehicles, refits and power-ups.
:mod:`.learn` fits that model to calibrations and detects changes. :mod:`.memory` reads the calibrations from
a catalogue, and :mod:`.page` writes HTML pages of the results.
"""
