"""A survey from its logs to its anomaly map.

::

    logs, tables --> read (corrected with a given calibration, or with one fitted to the same logs)
                       |
                    samples --> gridding (crustal field, levels, slow changes) --> maps, predictions
                       |                        |
                  crossovers (before)      crossovers (after)

The field is that of :mod:`magbridge.estimation.gaussian_field`, as in a calibration from a survey alone
(:mod:`magbridge.calibration.fitting.in_place`).
"""
