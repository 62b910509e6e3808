"""What the package makes of a small model: right, refused with its cause, or a silent miss."""

from __future__ import annotations

import json
import signal
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
from small_case import Case, Values, from_si, to_si

import casadi_engine as ce
from casadi_engine.errors import UnitError

LIMIT = 1e-5  # of the largest value of an output
ERRORS = 3.0  # standard errors
SLOW = 20.0  # s of CPU time: fifty times what the others take
TIGHT, WIDE = 0.3, 3.0  # of the standard error of a linearised least squares


@dataclass(frozen=True)
class Outcome:
    """kind : "right", "refused" (cause named), "refused, cause not named", "told" (no clean answer, and said so),
    "silent miss", "too slow", "crash".  detail : numbers, or the message
    """

    kind: str
    detail: str

    @property
    def passes(self) -> bool:
        return self.kind in ("right", "refused")


TOO_SLOW = Outcome("too slow", f"stopped after {SLOW:.0f} s of CPU time")


@contextmanager
def _limited(seconds: float) -> Iterator[list[bool]]:
    """Press Ctrl-C once this much CPU time is spent, and again each quarter of it; the list tells whether it was."""
    pressed: list[bool] = []

    def stop(number: int, frame: Any) -> None:
        pressed.append(True)
        signal.raise_signal(signal.SIGINT)

    before = signal.signal(signal.SIGPROF, stop)
    signal.setitimer(signal.ITIMER_PROF, seconds, seconds / 4)
    try:
        yield pressed
    except KeyboardInterrupt:
        if not pressed:
            raise
    finally:
        signal.setitimer(signal.ITIMER_PROF, 0)
        signal.signal(signal.SIGPROF, before)


def _refusal(case: Case, error: ce.CasadiEngineError) -> Outcome:
    text = f"{type(error).__name__}: {error}"
    named = isinstance(error, UnitError) or any(word in text for word in case.cause)
    return Outcome("refused" if named else "refused, cause not named", text)


def simulated(case: Case) -> Outcome:
    """Simulate at the true parameters from the true start."""
    try:
        with _limited(SLOW) as pressed:
            run = ce.simulate(case.build(dict(case.p)), case.record(noisy=False), initial=dict(case.start))
    except ce.CasadiEngineError as error:
        return _refusal(case, error)
    except Exception as error:  # noqa: BLE001 (a crash is an outcome to report)
        return Outcome("crash", f"{type(error).__name__}: {error}")
    if pressed:
        return TOO_SLOW
    worst = 0.0
    for name in case.outputs:
        channel = run[name]
        within = channel.time <= case.time[-1] + 1e-9
        truth = case.truth(channel.time[within])[name]
        found = to_si(channel.values[within], channel.unit)
        worst = max(worst, float(np.abs(found - truth).max() / np.abs(truth).max()))
    return Outcome("right" if worst <= LIMIT else "silent miss", f"relative error {worst:.1e}")


def recovered(case: Case) -> Outcome:
    """Fit one parameter to the noisy record."""
    model = case.build(dict(case.p))
    try:
        pars = model.parameters()
        for name in case.p:
            if name != case.free:
                pars.fix(name)
        pars[case.free].set(case.guess)
        initial: Any = dict(case.start) if case.known_start else None
        record = case.record(noisy=True)
        with _limited(SLOW) as pressed:
            fit = ce.estimate(model, record, parameters=pars, initial=initial, progress=False)
        if pressed:
            return TOO_SLOW
        found = fit.estimates[case.free]
    except ce.CasadiEngineError as error:
        return _refusal(case, error)
    except Exception as error:  # noqa: BLE001 (a crash is an outcome to report)
        return Outcome("crash", f"{type(error).__name__}: {error}")
    said = "; ".join(fit.messages)[:200]
    if fit.status != "converged":
        return Outcome("told", f"{fit.status}; {found.value:.6g}; {said}")
    true = case.p[case.free]
    if found.stderr is None or not np.isfinite(found.stderr):
        return Outcome("told", f"{found.value:.6g} for {true:.6g}, no error: {found.why}; {said}")
    off, ratio = (found.value - true) / found.stderr, found.stderr / expected_error(case)
    good = abs(off) <= ERRORS and TIGHT <= ratio <= WIDE
    return Outcome(
        "right" if good else "silent miss",
        f"{found.value:.6g} ± {found.stderr:.2g} for {true:.6g}: {off:+.1f} errors, error {ratio:.2f} × expected"
        + (f"; said: {said}" if said and not good else ""),
    )


TABLE = Path(__file__).with_name("small_errors.json")


@cache
def kept_errors() -> dict[str, list[float]]:
    return json.loads(TABLE.read_text(encoding="utf-8"))


def size_of(case: Case) -> float:
    """A number by which a case that was changed is told: of its parameters, its start and its clean record."""
    values = [*case.p.values(), *case.start.values(), case.level, *np.concatenate(list(case.clean.values()))]
    weights = np.linspace(1, 2, len(values))
    return float(weights @ np.arcsinh(np.abs(np.asarray(values, dtype=float))))


def expected_error(case: Case) -> float:
    """`linearised` from the table, which costs as much as a fit; that of a case that the table does not know anew."""
    size, error = kept_errors().get(case.name, (np.nan, np.nan))
    return error if np.isclose(size_of(case), size, rtol=1e-6, atol=0) else linearised(case)


def linearised(case: Case) -> float:
    """Standard error of the parameter by linearised least squares: SciPy's solution, central differences.

    Taken at the truth, which the optimum is within a few standard errors of. The start is estimated too, unless known.
    """
    sigma = case.sigma()

    def weighted(p: Values, start: Any) -> Any:
        made = case.truth(case.time, p, start)
        return np.concatenate([from_si(y, case.units[name]) / sigma[name] for name, y in made.items()])

    x0 = np.array(list(case.start.values()))
    step = 1e-5 * abs(case.p[case.free])
    ends = [weighted({**case.p, case.free: case.p[case.free] + s}, x0) for s in (step, -step)]
    columns = [(ends[0] - ends[1]) / (2 * step)]
    for k in range(0 if case.known_start else len(x0)):
        shift = np.zeros(len(x0))
        shift[k] = 1e-5 * max(abs(x0[k]), 1e-2)
        ends = [weighted(dict(case.p), x0 + s * shift) for s in (1, -1)]
        columns.append((ends[0] - ends[1]) / (2 * shift[k]))
    jacobian = np.array(columns).T
    size = np.maximum(np.linalg.norm(jacobian, axis=0), 1e-300)
    _, s, vt = np.linalg.svd(jacobian / size, full_matrices=False)
    keep = s > 1e-6 * s[0]  # a start that leaves no trace costs nothing
    return float(np.sqrt(((vt[keep, 0] / s[keep]) ** 2).sum()) / size[0])


if __name__ == "__main__":  # writes the table anew
    from small_models import CASES

    made = {name: [size_of(case), linearised(case)] for name, case in sorted(CASES.items())}
    TABLE.write_text(json.dumps(made, indent=0) + "\n", encoding="utf-8")
