"""The model of a vehicle's own magnetism: fit it, keep it, correct with it, simulate with it.

The live path needs :mod:`.correct` and :mod:`.file` only; neither imports scipy or xarray. :mod:`.fitting`
makes a calibration from logs, :mod:`.planning` says which calibration runs to fly next.
"""
