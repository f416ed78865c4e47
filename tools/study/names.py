"""Judge the names that a diagnosis gives to hidden effects."""

from __future__ import annotations

from collections.abc import Collection, Iterable

from studies import Row

from magbridge.diagnose.diagnosis import Diagnosis

EQUIVALENT = {"clock_offset": "filter_lag"}
"""Causes that count as one: in a uniform field, filter lag and clock offset have the same signature."""


def cause_names(causes: Iterable[str]) -> set[str]:
    """Return the set of cause names, with one name for equivalent causes."""
    return {EQUIVALENT.get(cause, cause) for cause in causes}


def judge(diagnosis: Diagnosis, hidden: Iterable[str], world: Collection[str] = ()) -> Row:
    """Return whether a diagnosis finds anything, its names, and whether the names of the `hidden` are right.

    The set of names, *sets*, holds the named causes, their alternatives and those of an unexplained residual.
    A diagnosis is *right* if it names all hidden causes, *in_set* if its set has them, *alone* if it names
    exactly these without alternatives. It has a *second* name if it names more causes than are hidden, except
    for the causes that are part of the `world`; without a hidden effect, more than these is a *false_alarm*.
    """
    first = [one.candidate.cause for one in diagnosis.findings]
    first += ["outliers"] * (diagnosis.wrong is not None)
    possible = [*first, *(candidate.cause for candidate in diagnosis.possible)]
    if diagnosis.unexplained is not None:
        possible += [one.candidate.cause for one in diagnosis.unexplained.within]
    truth, named, sets = cause_names(hidden), cause_names(first), cause_names(possible)
    found = diagnosis.verdict != "nothing_found"
    return {
        "found": found, "first": first, "named": sorted(named), "sets": sorted(sets),
        "right": truth <= named, "in_set": truth <= sets, "alone": named == sets == truth,
        "second": len(named.difference(world)) > max(len(truth), 1),
        "false_alarm": found and not (named and named <= set(world)),
    }  # fmt: skip
