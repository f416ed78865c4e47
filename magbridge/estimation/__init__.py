"""Statistics that every fit of magbridge shares: noise, Gaussian information, priors, optimisation, fields.

The package knows the scalar residual of a magnetometer and nothing else of the project: no logs, no MAVLink,
no file formats, no calibration files. It depends on numpy and scipy, on :mod:`magbridge.arrays`,
:mod:`magbridge.errors` and the splines of :mod:`magbridge.field`. ``residual`` needs numpy only, because the
live bridge imports it.

Start with :mod:`.residual` (what a fit minimises) and :mod:`.optimise` (how). Then read :mod:`.noise` (how
residuals are correlated), :mod:`.information` (what data say about unknowns), :mod:`.priors` and
:mod:`.hyperparameters` (what physics expects, and how wide), :mod:`.blocks` and :mod:`.select` (further
unknowns of a fit, and which of them stay), :mod:`.gaussian_field`, :mod:`.nodes`, :mod:`.sparse` and
:mod:`.elimination` (a random field in place with a sparse precision).

The live part needs numpy only: :mod:`.kalman` (a filter with considered states), :mod:`.track_process` (the
reference's error along a track, as its states) and :mod:`.sequential` (a test of its innovations for
changes).
"""
