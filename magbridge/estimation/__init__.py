"""Statistics that every fit of magbridge shares: noise, Gaussian information, priors, optimisation, fields.

The package contains statistics and the scalar residual of a magnetometer, but no logs, MAVLink, file formats
or calibration files. It depends on numpy and scipy, on :mod:`magbridge.arrays`, :mod:`magbridge.errors` and
the splines of :mod:`magbridge.field`. ``residual`` needs numpy only, because the live bridge imports it.

Start with :mod:`.residual` (the quantity that a fit minimises) and :mod:`.optimise` (the solver). Then read
:mod:`.noise` (correlation of residuals), :mod:`.information` (likelihood of Gaussian data), :mod:`.priors`
and :mod:`.hyperparameters` (physical priors, and their widths), :mod:`.blocks` and :mod:`.select` (further
unknowns of a fit, and the choice among them), :mod:`.gaussian_field`, :mod:`.nodes`, :mod:`.sparse` and
:mod:`.elimination` (a random field in space with a sparse precision).

The live part needs numpy only: :mod:`.kalman` (a filter with considered states), :mod:`.track_process` (the
reference's error along a track, as states of the filter) and :mod:`.sequential` (a test of the filter's
innovations for changes).
"""
