"""Exchange: what was found first was chosen without what was found later."""

from __future__ import annotations

from collections.abc import Sequence

from magbridge.diagnose.causes.candidates import Candidate
from magbridge.diagnose.inference.joint import Joint
from magbridge.diagnose.inference.rivals import Rival, rivals_of
from magbridge.diagnose.inference.rounds import Hypothesis, State
from magbridge.diagnose.inference.sharpen import sharpen
from magbridge.diagnose.inference.weigh import evidence_of_all

__all__ = ["exchanged"]

CHANGES = 6
"""At most."""
TRIED = 3
"""Rivals, in a cause's place."""


def exchanged(
    state: State, model: list[Candidate], base: Joint, null: Joint
) -> tuple[list[Candidate], Joint]:
    """Put a rival in a cause's place, profiled there, as long as the evidence of the whole grows."""

    def evidence(model: Sequence[Candidate], fit: Joint) -> float:
        ratio = 2.0 * (fit.log_likelihood - null.log_likelihood)
        return evidence_of_all(ratio, model) - sum(candidate.narrow for candidate in model)

    for _ in range(CHANGES):
        info, own = state.beside(model, base), evidence(model, base)
        tried = []
        for k in range(len(model)):
            best: dict[str, Rival] = {}
            for rival in rivals_of(state, info, model, base, k):
                best.setdefault(rival.cause, rival)
            best.pop(model[k].cause, None)
            others = model[:k] + model[k + 1 :]
            rest = state.fit(others) if best else base
            for rival in list(best.values())[:TRIED]:
                fit = state.fit([*others, rival.candidate], like=base)
                ratio = 2.0 * (fit.log_likelihood - rest.log_likelihood)
                there = sharpen(state, others, Hypothesis(rival.candidate, ratio, 0.0, 0.0, fit), rest)
                changed = [*others, there.candidate]
                tried.append((evidence(changed, there.fit) + rival.cheaper - own, changed, there.fit))
        gain, *_ = better = max(tried, key=lambda entry: entry[0], default=(0.0, model, base))
        if gain <= 0.0:
            break
        _, model, base = better
    return model, base
