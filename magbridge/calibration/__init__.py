"""The model of a vehicle's magnetism: fit, store, correct, simulate.

::

    logs --> fitting --> Calibration (model) <--> cal.json (file)
                              |
                              +--> Kernel (kernel)
                                                     |
    raw channels, telemetry --> correct <------------+--> forward <-- true field, telemetry
                                   |                         |
              total field, vector, sigmas, flags       what the sensor reads

A calibration is a list of :mod:`.terms` with their coefficients and covariance: polynomials in the positions
of the masses, a :mod:`.dipole` that is expanded into one, and effects, which depend on anything else
(:mod:`.effects`). Fits minimise the :mod:`~magbridge.estimation.residual`; :func:`.model.to_paper` gives
the result in the paper's terms, and :mod:`.planning` says which runs to fly next. The live path needs
:mod:`.correct` and :mod:`.file` only; neither imports scipy or xarray.
"""
