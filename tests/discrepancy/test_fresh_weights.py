"""Fresh data weigh structures: their log probability by each, and which one is left as the best."""

import math
from types import SimpleNamespace as stub

import numpy as np
import pytest
from scipy.integrate import solve_ivp

import casadi_engine as ce
from casadi_engine.discrepancy import fresh_weights as module
from casadi_engine.discrepancy.fresh_weights import FreshWeights
from casadi_engine.discrepancy.parameter_doubt import log_foretold
from casadi_engine.discrepancy.repair import _EXCHANGED


def test_fresh_data_are_as_probable_as_noise_and_errors_of_the_parameters_make_them():
    """Against the normal law of both together, its covariance written out."""
    rng = np.random.default_rng(0)
    slope, sigma, error, n = rng.standard_normal(50), 0.3, 0.2, 50
    record = stub(name="r", outputs=("y",), slopes={"y": slope[:, None]}, starts=())
    null = stub(
        parameters=("z",), values=np.array([1.0]), turn=np.eye(1), prior=np.zeros((0, 2)), records=(record,)
    )
    errors = stub(names=("z",), over=lambda names: (np.array([[1 / error]]), np.zeros(1)))
    fit = stub(errors=errors, values={"z": 1.0}, noise={"y": (sigma, True)})
    # what the fit knows, and one sample
    spread = 1 / (1 / error**2 + (slope @ slope) / (n * sigma**2))
    covariance = sigma**2 * np.eye(n) + spread * np.outer(slope, slope)
    found, expected = [], []
    for size in (0.0, 1.0, 3.0):
        e = sigma * rng.standard_normal(n) + size * error * slope
        record.residual = {"y": e}
        found.append(log_foretold(fit, null, {"y": sigma}))
        whole = -0.5 * e @ np.linalg.solve(covariance, e) - 0.5 * np.linalg.slogdet(covariance)[1]
        expected.append(whole + n * math.log(sigma))
    assert found == pytest.approx(expected, rel=1e-9)


def tried(name, log, *, beyond=10.0):
    """A structure of one effect, or of none for an empty name, with a log evidence; a number more for each +."""
    effect = stub(
        nuisance=dict.fromkeys(range(name.count("+")), stub(whole=False)), key=f"p.{name}", width=None
    )
    effect.candidate = stub(source=stub(effect=stub(limit="")))
    one = stub(
        key=frozenset([(name, "p")] if name else []),
        effects=(effect,) if name else (),
        label=name,
        name=name,
        fresh=0.0,
    )
    one.beyond, one.evidence, one.arrived = beyond, log, stub(values={})
    return one


class Pool(dict):
    """Structures whose log counts what fresh data say."""

    def __getitem__(self, key):
        one = super().__getitem__(key)
        one.log, one.counted = one.evidence + one.fresh, one.evidence
        return one

    def values(self):
        return [self[key] for key in self]


def weighed(monkeypatch, logs, fresh, *, sure=True, significant=True, left=1.0, most=1, more=()):
    """The name of the best structure, what is said, and which were asked, where ``fresh`` are the log probabilities of
    fresh data; left : chi-squared per sample that all leave there; more : structures of two effects, with their log
    evidence, that are refitted with the name of the first one."""
    pool = Pool({one.key: one for one in (tried(name, log) for name, log in logs.items())})
    best = max(pool.values(), key=lambda t: t.log).key
    levels = stub(sigma={"y": 1.0}, weight=lambda name: 1.0)
    fits = {key: object() for key in pool}
    names = {id(fits[key]): pool[key].label for key in pool}
    search = stub(
        pool=pool, best=best, price=2.0, refits=stub(levels=levels),
        null=stub(screened=stub(significant=significant)), way=lambda key: [stub(fit=fits[key])],
        fit_of=lambda one: fits[one.key], most=most, tell=None,
    )  # fmt: skip
    search.null.screened.order = search.null.screened.candidates = ()
    search.refits.weigh = lambda: None

    def with_one_more(refits, one, *rest):
        pool.update({t.key: t for t in two if t.label.startswith(one.label)})
        return [pool[t.key] for t in two if t.label.startswith(one.label)]

    two = []
    for name, log in more:
        made = tried(name, log)
        made.key, made.effects = frozenset([(part, "p") for part in name]), 2 * made.effects
        fits[made.key] = object()
        names[id(fits[made.key])] = name
        two.append(made)
    monkeypatch.setattr(module, "families_of", lambda screened: {})
    monkeypatch.setattr(module, "with_one_more", with_one_more)
    record = stub(residual={"y": np.ones(10)})
    monkeypatch.setattr(module, "doubted", lambda fit, held: stub(records=(record,)))
    asked = []

    def foretold(fit, null, levels):
        asked.append(names[id(fit)])
        return fresh[names[id(fit)]]

    monkeypatch.setattr(module, "log_foretold", foretold)
    monkeypatch.setattr(module, "left_within_errors", lambda *_: left)
    said = []
    FreshWeights(search, lambda fit, effects: [(stub(converged=True), None)], said).run(sure=sure)
    return pool[search.best].label, said, set(asked)


def test_rivals_are_told_apart_by_fresh_data(monkeypatch):
    best, said, _ = weighed(monkeypatch, {"a": 0.0, "b": -1.0, "": -50.0}, {"a": -9.0, "b": -2.0})
    assert best == "b"
    assert said == ["fresh data tell b from a: with them it is 4e+02 times as probable"]


@pytest.mark.parametrize(("logs", "fresh", "lead"), [
    ({"a": 0.0, "b": -0.7}, {"a": -1.2, "b": 0.0}, "b"),  # not told apart, and as simple: the more probable one
    ({"a": 0.0, "b+": -0.7}, {"a": -1.2, "b+": 0.0}, "a"),  # the simpler one
    ({"a+": 0.0, "b": -0.7}, {"a+": -0.2, "b": 0.0}, "b"),
    ({"a": 0.0, "b+": -0.7}, {"a": -2.2, "b+": 0.0}, "b+"),  # told apart
])  # fmt: skip
def test_of_what_fresh_data_do_not_tell_apart_the_simplest_leads_and_else_the_most_probable(
    monkeypatch, logs, fresh, lead
):
    assert weighed(monkeypatch, {**logs, "": -50.0}, fresh)[0] == lead


def test_fresh_data_that_no_structure_knows_tell_none_apart(monkeypatch):
    best, said, asked = weighed(monkeypatch, {"a": 0.0, "b": -1.0, "": -50.0}, {}, left=40.0)
    assert (best, said, asked) == ("a", [], set())


def test_what_the_search_excludes_is_asked_only_where_fresh_data_do_not_confirm(monkeypatch):
    logs, fresh = {"a": 0.0, "b": -5.0, "": -50.0}, {"a": -20.0, "b": 0.0}
    assert weighed(monkeypatch, logs, fresh, sure=True)[0] == "a"
    assert weighed(monkeypatch, logs, fresh, sure=False)[0] == "b"


def test_one_structure_alone_is_not_weighed(monkeypatch):
    best, said, asked = weighed(monkeypatch, {"a": 0.0, "b": -30.0, "": -50.0}, {})
    assert (best, said, asked) == ("a", [], set())


def test_an_effect_that_the_search_could_not_name_is_named_by_fresh_data(monkeypatch):
    logs, fresh = {"": 0.0, "a": -1.0}, {"": -30.0, "a": 0.0}
    assert weighed(monkeypatch, logs, fresh)[0] == "a"
    assert weighed(monkeypatch, logs, fresh, significant=False)[0] == ""
    assert weighed(monkeypatch, logs, {"": -5.0, "a": 0.0})[0] == ""  # less than one more effect has to gain


# ---- the search in the fresh records


def _rotor():
    b = ce.Blueprint("rotor")
    gain = b.parameter("K", 0.8, unit="rad/(s N m)", min=0.01, max=10)
    lag = b.parameter("T", 3.0, unit="s", min=0.1, max=50)
    w, u = b.state("w", unit="rad/s"), b.input("u", unit="N m")
    load = b.port("load", "inertia", {"speed": w})
    b.ode("w", (gain * u - w + load) / lag)
    b.output("w", w, unit="rad/s")
    return b.model()


def _run(name, size, seed):
    """A rotor with drag, driven at some size; by SciPy."""
    t = np.arange(400) * 0.1
    u = size * np.sign(np.sin(0.9 * t))

    def rate(x, s):
        return (np.interp(x, t, u) - s - 0.3 * s * abs(s)) / 2.0

    run = solve_ivp(rate, (0, t[-1]), [0.0], t_eval=t, max_step=0.05, rtol=1e-9, atol=1e-11)
    w = run.y[0] + 0.05 * np.random.default_rng(seed).standard_normal(400)
    return ce.Experiment.from_arrays(name, time=t, units={"u": "N m", "w": "rad/s"}, u=u, w=w)


def test_the_search_goes_to_the_fresh_records_where_these_alone_show_what_is_missing():
    slow, fast = _run("slow", 0.15, 0), _run("fast", 4.0, 1)
    few = ["quadratic_drag", "coulomb_friction", "constant_torque"]
    found = ce.repair(
        _rotor(), slow, fresh=fast, effects=few, noise=ce.Noise(w=0.05), starts=1, progress=False
    )
    assert found.verdict == "named"
    assert [one.key for one in found.effects] == ["load.quadratic_drag"]
    assert [record.name for record in found.data] == ["fast"]
    assert [record.name for record in found.fresh] == ["slow"]
    assert _EXCHANGED.split(",")[0] in " ".join(str(found).split())
    assert abs(found.effects[0].amplitude.value - 0.3) < 4 * found.effects[0].amplitude.stderr


@pytest.mark.parametrize(("log", "of_fresh", "lead"), [
    (0.5, 0.0, "a"),  # it has not gained the price of 2
    (2.5, 0.0, "bc"),  # it has
    (0.5, 5.0, "bc"),  # by fresh data
    (-7.0, 60.0, "a"),  # so far behind that it is not asked
])  # fmt: skip
def test_what_fresh_data_alone_exclude_is_asked_again_with_one_more_effect(monkeypatch, log, of_fresh, lead):
    logs, fresh = {"a": 0.0, "b": -1.0, "": -50.0}, {"a": 0.0, "b": -30.0, "bc": of_fresh}
    best, said, asked = weighed(monkeypatch, logs, fresh, most=2, more=[("bc", log)])
    assert (best, "bc" in asked) == (lead, log > -7)
    told = "fresh data tell a from b: with them it is more than a million times as probable"
    assert said == ([told] if lead == "a" else [])
    assert weighed(monkeypatch, logs, fresh, most=1, more=[("bc", log)])[0] == "a"


def test_what_the_search_excludes_itself_is_not_asked_again(monkeypatch):
    logs, fresh = {"a": 0.0, "b": -5.0, "": -50.0}, {"a": 0.0, "b": -30.0, "bc": 9.0}
    assert "bc" not in weighed(monkeypatch, logs, fresh, sure=False, most=2, more=[("bc", 9.0)])[2]
