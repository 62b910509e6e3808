"""result.json of ``repair``, by the contract."""

from __future__ import annotations

import math
from typing import Any

from casadi_engine.discrepancy.confirmation import PairedGain
from casadi_engine.discrepancy.input_hold import TAKEN
from casadi_engine.discrepancy.repaired import FoundEffect, Gaps, Nearest, Place, Repair, Side, Unknown
from casadi_engine.effects.protocol import settings_of
from casadi_engine.estimation.fit import Estimate, Fit
from casadi_engine.report.result_file import (
    _for_warm_start,
    content,
    describe,
    noise,
    optima_of,
    parameters_of,
)

ONLY_WITH_EFFECT = "it has a meaning with the effect alone"


@content.register
def _(result: Repair) -> dict[str, Any]:
    fit = result.fit
    stored = _for_warm_start(fit)
    why = stored.pop("why")
    why |= {} if result.threshold is not None else {"threshold": result.status}
    messages = list(dict.fromkeys([*result.messages, *stored.pop("messages")]))
    return {
        "status": result.status,
        "timing": dict(result.timing),
        "inputs": describe((*result.data, *result.fresh), fit.model),
        "noise": noise(fit),
        "cost": fit.cost,
        "n": fit.n,
        "parameters": parameters_of(fit),
        "verdict": result.verdict,
        "confirmed": result.confirmed,
        "null_fit": _null_fit(result),
        "alpha": result.alpha,
        "threshold": result.threshold,
        "candidates": result.candidates,
        "effects": [_effect(one, fit) for one in result.effects],
        "withdrawn": [_effect(one, fit) for one in result.withdrawn],
        "where": None if result.where is None else _place(result.where),
        "gap": None if result.gaps is None else _gaps(result.gaps),
        "unknown": None if result.unknown is None else _unknown(result.unknown),
        "not_found": [
            {"name": one.name, "at": one.at}
            | _size(one.smallest_detectable if one.testable else math.inf, one.note)
            | {"unit": one.unit, "testable": bool(one.testable), "note": one.note, "twin": one.twin}
            for one in result.not_found
        ],
        "not_applicable": [
            {
                "name": one.effect,
                "at": one.at,
                "missing": list(one.missing),
                "has": list(one.has),
                "why": one.why,
            }
            for one in result.not_applicable
        ],
        "next_experiment": _next(result),
        "equation": None
        if result.equation is None
        else {"text": result.equation.text, "latex": result.equation.latex},
        "scores": _scores(result),
        "score_noise": _score_noise(result),
        "with_hold": dict(result.options.get(TAKEN, {})),
        "fresh": [one.name for one in result.fresh],
        "stopped": result.stopped,
        "not_searched": list(result.not_searched),
        "nearest": None if result.nearest is None else _nearest(result.nearest),
        "summary": str(result),
        **stored,
        "messages": messages,
        "why": why,
    }


def _nearest(near: Nearest) -> dict[str, Any]:
    """The model with the effects that were withdrawn: its parameters and the gap with it."""
    return {
        "effects": list(near.names),
        "values": dict(near.fit.values),
        "rmse": dict(near.estimation.rmse),
        "rmse_fresh": None if near.validation is None else dict(near.validation.rmse),
    }


def _null_fit(result: Repair) -> dict[str, Any]:
    fit = result.null_fit
    return {
        "cost": fit.cost,
        "n": fit.n,
        "status": fit.status,
        "optima": optima_of(fit),
        "values": {name: estimate.value for name, estimate in fit.estimates.items()},
    }


def _effect(one: FoundEffect, fit: Fit) -> dict[str, Any]:
    amplitude = next(iter(one.parameters))
    terms = [term.effect for term in fit.model.effects if term.key == one.key]
    made = {
        "name": one.name,
        "at": one.at,
        "sentence": one.sentence,
        "parameters": {name: _parameter(found, name == amplitude) for name, found in one.parameters.items()},
        "constants": dict(one.constants),
        "z": one.z,
        "p_value": one.p_value,
        "drop": one.drop,
        "share_explained": one.share_explained,
        "predicted_shift": dict(one.predicted_shift),
        "found_shift": dict(one.found_shift),
        "selection_frequency": one.selection_frequency,
        "class": [
            {"name": member.name, "at": member.at, "rho": member.rho, "probability": member.probability}
            for member in one.members
        ],
    }
    made["settings"] = settings = settings_of(terms[0]) if terms else {}
    # over which its corners are rounded, and what is taken off an input that hardly varies, as before there were more
    made |= {key: own for key in ("width", "about") if (own := settings.get(key)) is not None}
    if one.selection_frequency is None:
        made["why"] = {"selection_frequency": "too few cycles to draw halves of them"}
    return made


def _parameter(found: Estimate, is_amplitude: bool) -> dict[str, Any]:
    why = {} if is_amplitude else {"null": ONLY_WITH_EFFECT}
    error = None if found.at_bound else found.stderr
    if error is None:
        why["stderr"] = found.why or ("it rests on its bound" if found.at_bound else "not known")
    made = {"value": found.value, "stderr": error, "unit": found.unit, "null": 0.0 if is_amplitude else None}
    return made | ({"why": why} if why else {})


def _place(place: Place) -> dict[str, Any]:
    return {
        "location": place.location,
        "record": place.record,
        "time": list(place.time),
        "cycles": None if place.cycles is None else list(place.cycles),
        "crank_angle": None if place.crank_angle is None else list(place.crank_angle),
        "order": place.order,
        "excess": dict(place.excess),
        "why": {} if place.order is not None else {"order": "no engine order stands out"},
    }


def _gaps(gaps: Gaps) -> dict[str, Any]:
    before, after = gaps.validation_before, gaps.validation_after
    made: dict[str, Any] = {
        "estimation": {"before": _side(gaps.estimation_before), "after": _side(gaps.estimation_after)},
        "validation": None
        if before is None or after is None
        else {"before": _side(before), "after": _side(after)},
        "gain_per_cycle": None if gaps.gain_per_cycle is None else _gain(gaps.gain_per_cycle),
        "source": gaps.source,
    }
    return made


def _side(side: Side) -> dict[str, Any]:
    why = {
        f"whiteness_p.{record}.{output}": "the test cannot be made"
        for record, outputs in side.whiteness_p.items()
        for output, p in outputs.items()
        if p is None
    }
    percent = {name: value if math.isfinite(value) else None for name, value in side.gap.fit_percent.items()}
    why |= {
        f"fit_percent.{name}": "the measured output does not vary: (2.32) divides by its variation"
        for name, value in percent.items()
        if value is None
    }
    of_fresh = {"within_errors": side.within_errors, "parameters_p": side.parameters_p}
    return {
        "rmse": dict(side.gap.rmse),
        "fit_percent": percent,
        "whiteness_p": {record: dict(outputs) for record, outputs in side.whiteness_p.items()},
        "chi2_per_sample": side.gap.chi2_per_sample,
        "samples": side.gap.samples,
        "why": why,
    } | {key: value for key, value in of_fresh.items() if value is not None}


def _gain(gain: PairedGain) -> dict[str, Any]:
    made: dict[str, Any] = {"mean": gain.mean, "se": gain.se, "cycles": gain.cycles}
    why = {key: gain.why or "too few cycles" for key in ("mean", "se") if made[key] is None}
    return made | ({"why": why} if why else {})


def _unknown(unknown: Unknown) -> dict[str, Any]:
    course = unknown.course
    made: dict[str, Any] = {
        "sentence": unknown.sentence,
        "tests": dict(unknown.tests),
        "at": unknown.port,
        "signal": unknown.signal,
        "p_value": unknown.p_value,
        "odds": unknown.odds,
        "looks_like": {} if course is None else dict(course.looks_like),
        "course": None
        if course is None
        else {"signal": course.signal, "torque": course.mean, "stderr": course.band},
    }
    why = {} if unknown.p_value is not None else {"p_value": "no function of a signal explains it"}
    return made | ({"why": why} if why else {})


def _size(value: float, note: str) -> dict[str, Any]:
    if math.isfinite(value):
        return {"smallest_detectable": value}
    why = f"not testable: {note or 'the free parameters explain all that it does in these data'}"
    return {"smallest_detectable": None, "why": {"smallest_detectable": why}}


def _next(result: Repair) -> dict[str, Any] | None:
    found = result.next_experiment
    if found is None:
        return None
    return {
        "change": found.change,
        "splits": list(found.splits),
        "expected_separation": found.expected_separation,
        "separation_now": found.separation_now,
    }


def _scores(result: Repair) -> list[dict[str, Any]]:
    """The best score of each effect at each port."""
    return [
        {"name": row.effect, "at": row.at, "values": dict(row.values), "z": row.z, "p_value": row.p_value}
        | {"amplitude": row.amplitude, "unit": row.unit, "testable": bool(row.testable)}
        | {"significant": bool(row.significant)}
        for row in result.best_scores
    ]


def _score_noise(result: Repair) -> dict[str, Any] | None:
    found = result.noise
    if found is None:
        return None
    return {
        "sigma": {
            name: {"sigma": sigma, "estimated": bool(known)} for name, (sigma, known) in found.sigma.items()
        },
        "colour": dict(found.colour),
        "scatter": dict(found.scatter),
    }
