"""Inference: which candidates the data support.

*The likelihood.* :mod:`.noise` whitens, and :mod:`.fit_noise` fits it to a residual; :mod:`.design` holds the
columns of a hypothesis, and :mod:`.joint` fits them together with calibration and noise.

*One candidate.* :mod:`.information` has scores and Fisher information of all candidates at once;
:mod:`.statistic` is their likelihood ratio, :mod:`.evidence` its posterior odds and its test.

*The search.* :mod:`.search` adds cause after cause, each in a round of the :mod:`.state`.
:mod:`.profile_likelihood` refines nonlinear parameters, :mod:`.competing` replaces causes by their
:mod:`.competing`, also in :mod:`.pairs`.

*Reliability.* :mod:`.nonlinear_uncertainty` widens the covariance, :mod:`.outliers` tests for isolated
wrong samples, and :mod:`.isolability` says what such a log could have shown at all.
"""
