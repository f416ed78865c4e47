"""The model of a vehicle's magnetism: fit, store, correct, simulate.

::

    logs --> fitting --> Calibration (model) <--> cal.json (file)
                              |
                              +--> Kernel (kernel)
                                                     |
    raw channels, telemetry --> correct <------------+--> forward <-- true field, telemetry
                                   |                         |
              total field, vector, sigmas, flags       what the sensor reads

A calibration is a list of :mod:`.terms` with their coefficients and covariance. Position terms are
polynomials in the positions of the masses, or a :mod:`.dipole` that is expanded into a polynomial. Effects
depend on other telemetry, on time or on the reading (:mod:`.effects`). Fits minimise the
:mod:`~magbridge.estimation.residual`. :func:`.model.to_paper` converts the result to the paper's
parameters, and :mod:`.planning` chooses the runs to fly next. The live path needs :mod:`.correct` and
:mod:`.file` only; neither imports scipy or xarray.
"""
