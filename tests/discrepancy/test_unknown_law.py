"""An unknown law in the place of effects that were found: more probable than wrong names, less than right ones."""

import math
from dataclasses import replace
from types import SimpleNamespace

import casadi as ca
import numpy as np
import pytest
from scipy.integrate import solve_ivp

import casadi_engine as ce
from casadi_engine.discrepancy import answer
from casadi_engine.discrepancy.certificate import as_untried, in_place_of, law_words
from casadi_engine.discrepancy.random_families import Family
from casadi_engine.discrepancy.refit import Refitter, addition
from casadi_engine.discrepancy.refits import Refits
from casadi_engine.discrepancy.repaired import UNTRIED, Unknown, in_its_place
from casadi_engine.discrepancy.screening import screen
from casadi_engine.discrepancy.unknown_law import (
    UnknownLaw,
    depends_on,
    depends_on_more,
    does_more,
    imitators,
    not_told_from,
)
from casadi_engine.discrepancy.verdict_words import _law_alone


def brake(speed):
    """An eddy-current brake: a law that no library has."""
    return 1.2 * (speed / 3) / (1 + (speed / 3) ** 2)


def wave(speed):
    """A law that comes and goes with speed: no friction does."""
    return 0.25 * np.sin(1.2 * speed)


def drag(speed):
    return 0.01 * speed * abs(speed)


def run(law, seed, *, noise=0.04):
    """0.4 kg m2 with viscous friction and a law, by an integrator of its own."""
    time = np.arange(500) * 0.04
    rng = np.random.default_rng(seed)
    tones = 2 * np.pi * np.array([0.06, 0.17, 0.43])
    torque = 1.5 * np.sin(tones[:, None] * time + rng.uniform(0, 6, (3, 1))).sum(axis=0) + 1.0

    def rate(t, w):
        return (np.interp(t, time, torque) - 0.15 * w - law(w)) / 0.4

    speed = solve_ivp(rate, (0, time[-1]), [0.0], t_eval=time, rtol=1e-9, atol=1e-9, max_step=0.04).y[0]
    shown = speed + noise * rng.standard_normal(len(time))
    units = {"T": "N m", "omega": "rad/s"}
    return ce.Experiment.from_arrays(f"run {seed}", time=time, units=units, T=torque, omega=shown)


def repaired(law, **options):
    effects = ["coulomb_friction", "quadratic_drag", "constant_torque"]
    return ce.repair(
        ce.one_inertia(), run(law, 1), fresh=run(law, 2), effects=effects, starts=1, progress=False, **options
    )


@pytest.fixture(scope="module")
def braked():
    return repaired(brake)


@pytest.mark.slow  # test_law_refit.py has one without a name in the quick run
def test_an_unknown_law_is_no_colour_of_the_noise(tmp_path):
    found = repaired(wave)
    assert found.verdict == "unnamed"
    assert found.effects == ()
    unknown = found.unknown
    assert (unknown.port, unknown.signal) == ("engine", "speed")
    assert unknown.sentence.startswith("an unknown torque at engine that depends on its speed")
    assert unknown.odds >= 20
    assert "more probable than" in unknown.sentence
    ce.report(found, tmp_path / "page.html")
    assert "an unknown torque at engine" in (tmp_path / "page.html").read_text()


def test_a_name_that_comes_near_an_unknown_law_says_so(braked, tmp_path):
    """Dry friction takes 98 % of what the brake does: the nearest of the library, and not the law."""
    unknown = braked.unknown
    assert unknown.odds >= 20
    assert (unknown.port, unknown.signal) == ("engine", "speed")
    assert "the nearest of the library, which explains" in unknown.sentence
    text = str(braked)
    assert "or rather a law that the library lacks" in " ".join(text.split())
    assert braked.verdict == "class"
    assert "Note: the ± cover noise alone; what is still unexplained may move the values by more" in " ".join(
        text.split()
    )
    assert "Next: look at the curve of the unknown torque" in " ".join(text.split())
    assert "More probable in its place: an unknown torque at engine" in " ".join(text.split())
    ce.report(braked, tmp_path / "page.html")
    assert "In its place: an unknown torque at engine" in (tmp_path / "page.html").read_text()


def test_the_course_of_an_unknown_law_is_drawn(braked):
    """Up to a constant and a slope, which belong to the friction that is fitted beside it."""
    course = braked.unknown.course
    seen = course.family.visited > 0.002
    weight = np.sqrt(course.family.visited[seen])
    plain = np.column_stack([np.ones_like(course.signal), course.signal])[seen] * weight[:, None]

    def bent(values):
        own = values[seen] * weight
        return own - plain @ np.linalg.lstsq(plain, own, rcond=None)[0]

    assert np.corrcoef(bent(course.mean), bent(-brake(course.signal)))[0, 1] > 0.97


@pytest.mark.slow  # a friction is, in test_repair_requests.py
def test_a_law_of_the_library_is_more_probable_than_an_unknown_one():
    found = repaired(drag)
    assert [one.key for one in found.effects] == ["engine.quadratic_drag"]
    assert found.verdict == "named"
    assert found.unknown is None or found.unknown.odds is None
    assert math.isfinite(found.effects[0].amplitude.value)


@pytest.mark.parametrize(
    ("port", "signal", "order", "words"),
    [
        ("engine", "turn", 1, "an unknown torque at engine that comes back once a turn"),
        ("engine", "turn", 2, "an unknown torque at engine that comes back 2 times a turn"),
        ("engine", "place", 0, "an unknown torque at engine that depends on its place, its speed added up"),
        ("input_T", "value", 0, "the input T acts as another function of its value"),
        ("sensor_omega", "value", 0, "the sensor omega shows another function of its value"),
    ],
)
def test_a_law_in_words(port, signal, order, words):
    family = Family(port, signal, (0,), np.ones(1), 0.0, 1.0, np.ones(61), order)
    assert law_words(ce.one_inertia(), family) == words


@pytest.mark.parametrize(
    ("acts", "signal", "own"),
    [
        (lambda w, u: -w * ca.fabs(w), "speed", True),
        (lambda w, u: -w * u, "speed", False),
        (lambda w, u: ca.SX(1.0), "speed", False),  # of nothing that moves
        (lambda w, u: -w, "angle", False),  # the port has none
    ],
)
def test_a_candidate_depends_on_a_signal_of_its_port_and_on_nothing_else(acts, signal, own):
    model = ce.one_inertia()
    none = ca.SX.zeros(1, 1)
    source = SimpleNamespace(model=model, slots=acts(model.x[0], model.u[0]), drives=none, outputs=none)
    assert depends_on(SimpleNamespace(source=source, port="engine"), signal) is own


def test_an_answer_is_kept_where_the_law_cannot_be_told(monkeypatch):
    def fails(*_, **__):
        raise np.linalg.LinAlgError("SVD did not converge")

    monkeypatch.setattr(answer, "unknown_law", fails)
    found = ce.repair(
        ce.one_inertia(), run(drag, 1), effects=["quadratic_drag"], holdout=0, starts=1, progress=False
    )
    assert [one.key for one in found.effects] == ["engine.quadratic_drag"]
    assert any("not told, as its numbers fail (SVD did not converge)" in text for text in found.messages)


@pytest.mark.parametrize(("share", "said"), [(0.9, True), (2.05, False)])
def test_a_share_above_all_that_a_law_does_is_not_said(share, said):
    """Effects may take more of chi-squared than a law that is linearised far from them: that is no share of it."""
    family = Family("engine", "speed", (0,), np.ones(1), 0.0, 1.0, np.ones(61))
    course = SimpleNamespace(family=family, looks_like={})
    last = SimpleNamespace(
        fit=SimpleNamespace(model=ce.one_inertia()), effects=(SimpleNamespace(name="drag at engine"),)
    )
    words = in_place_of(last, UnknownLaw(course, 9.5, share)).sentence
    assert words.endswith("the nearest of the library, which explains 90 % of what that does") is said
    assert ("explains" in words) is said


@pytest.mark.parametrize("far", [False, True])
def test_a_law_along_a_simulation_that_is_far_off_has_no_certain_place(far):
    """Dry friction of a roller was "an unknown torque at motor", by the simulation without it."""
    family = Family("engine", "speed", (0,), np.ones(1), 0.0, 1.0, np.ones(61))
    course = SimpleNamespace(family=family, looks_like={})
    noise = SimpleNamespace(colour={})
    last = SimpleNamespace(
        fit=SimpleNamespace(model=ce.one_inertia()), effects=(), screened=SimpleNamespace(noise=noise)
    )
    unknown = in_place_of(last, UnknownLaw(course, 9.5, 0.0), far=far)
    assert unknown.sentence.endswith("where it acts is not certain") is far
    found = SimpleNamespace(unknown=unknown)
    said = ": an unknown torque at engine that depends on its speed"
    assert _law_alone(found) == said + (", but where it acts is not certain" if far else "")
    untried = replace(unknown, sentence=as_untried(unknown.sentence))
    assert as_untried("a law; an effect is near") == f"a law, but {UNTRIED}; an effect is near"
    assert untried.sentence.count("where it acts is not certain") == 1
    assert _law_alone(SimpleNamespace(unknown=untried)) == f"{said}, but {UNTRIED}"


def test_laws_that_the_data_do_not_tell_apart_are_named_together():
    """ "The parameter m is not constant: it depends on F" stood as a fact where other functions did as well."""
    speed, place, drive, time = (
        Family(port, signal, (0,), np.ones(1), 0.0, 1.0, np.ones(61))
        for port, signal in (
            ("engine", "speed"),
            ("engine", "place"),
            ("input_T", "value"),
            ("engine", "time"),
        )
    )
    found = [(time, -3.1), (drive, -1.0), (speed, 0.0), (place, 0.001)]  # log(20) is 3.0
    assert not_told_from(speed, found) == (drive,)  # the place is the speed by another name
    assert not_told_from(drive, [(drive, -1.0), (time, -3.1), (speed, -1.5)]) == (speed, time)
    course = SimpleNamespace(family=speed, looks_like={"cubic": 0.9})
    last = SimpleNamespace(
        fit=SimpleNamespace(model=ce.one_inertia()), effects=(SimpleNamespace(name="drag at engine"),)
    )
    words = in_place_of(last, UnknownLaw(course, 9.5, 0.5, rivals=(drive, drive, time))).sentence
    assert words.startswith(
        "an unknown torque at engine that depends on its speed and looks cubic, or the input T acts as another "
        "function of its value: far more probable than drag at engine"
    )
    # a sensor that drifts was the answer where no refit of a spring had arrived
    course = SimpleNamespace(family=time, looks_like={})
    words = in_place_of(last, UnknownLaw(course, 9.5, 0.5, unheard=(speed,))).sentence
    assert words.startswith(
        "an unknown torque at engine that depends on time, or an unknown torque at engine that depends on its speed, "
        "which was not followed to its end: far more probable"
    )


@pytest.mark.parametrize(
    ("several", "share", "said"), [(True, 0.99, True), (True, 1.2, False), (False, 0.99, False)]
)
def test_several_effects_at_a_port_that_a_curve_replaces_say_so(several, share, said):
    """A constant power at 10 to 29 V is friction and Stribeck's law together: that these are fewer numbers than a
    function of the voltage is all that speaks for them, and no proof that no other law is there."""
    family = Family("engine", "speed", (0,), np.ones(1), 0.0, 1.0, np.ones(61))
    course = SimpleNamespace(family=family, looks_like={})
    effects = (SimpleNamespace(name="stribeck_friction"), SimpleNamespace(name="coulomb_friction"))
    last = SimpleNamespace(fit=SimpleNamespace(model=ce.one_inertia()), effects=effects)
    unknown = in_place_of(last, UnknownLaw(course, -10.0, share, several))
    assert (unknown is not None) is said
    if said:
        assert unknown.sentence.endswith("explains no less: fewer numbers alone speak for these")
        assert unknown.odds < 1


# ---- an effect beside a law of no name


class LoadFriction(ce.Effect):
    """Dry friction that is a share of the load."""

    name, attaches, kin = "load_friction", ("inertia",), ("coulomb_friction",)
    sentence = "dry friction at {port} that grows with the load"
    amplitude = ce.effects.Amplitude("share", unit="1", min=0)
    nuisance = {}  # noqa: RUF012

    def law(self, port, p, math):
        return -p.share * port.load * math.sign(port.speed, width=0.1)


def under_load():
    """0.4 kg m2 under a load that is measured."""
    b = ce.Blueprint("under_load")
    inertia = b.parameter("J", 0.4, unit="kg m2", min=0.2, max=0.8)
    friction = b.parameter("d", 0.15, unit="N m s/rad", min=0, max=3)
    torque, load = (b.input(name, unit="N m", scale=10) for name in ("T", "load"))
    speed = b.state("w", unit="rad/s", scale=10)
    port = b.port("engine", "inertia", {"speed": speed, "load": load})
    b.ode("w", (torque - load - friction * speed + port) / inertia)
    b.output("omega", speed, unit="rad/s", scale=10)
    return b.model()


def run_under_load(tied):
    """With 0.3 of the load more and the brake; tied : the load is half the speed, else it has a course of its own."""
    time, rng = np.arange(300) * 0.04, np.random.default_rng(1)
    tones = 2 * np.pi * np.array([0.06, 0.17, 0.43])

    def course(level, size):
        return level + size * np.sin(tones[:, None] * time + rng.uniform(0, 6, (3, 1))).sum(axis=0)

    torque, own = course(10.0, 1.5), course(5.0, 1.0)

    def rate(t, w):
        load = 0.5 * w if tied else np.interp(t, time, own)
        return (np.interp(t, time, torque) - 1.3 * load - 0.15 * w - 2 * brake(w / 2)) / 0.4

    speed = solve_ivp(rate, (0, time[-1]), [8.0], t_eval=time, rtol=1e-9, atol=1e-9, max_step=0.04).y[0]
    return ce.Experiment.from_arrays(
        "run",
        time=time,
        units={"T": "N m", "load": "N m", "omega": "rad/s"},
        T=torque,
        load=0.5 * speed if tied else own,
        omega=speed + 0.02 * rng.standard_normal(len(time)),
    )


@pytest.mark.parametrize("tied", [False, True])
def test_only_what_no_function_of_the_speed_does_is_missing_beside_it(tied):
    """Friction of a load that goes its own way is no part of a law in speed; that of a load which the speed tells may
    be, and dry friction is."""
    data, known = run_under_load(tied), ce.Noise(omega=0.02)
    model = under_load()
    fit = ce.estimate(model, data, noise=known, progress=False, errors="quadratic")
    screened = screen(fit, ["coulomb_friction", LoadFriction()])
    dry, of_load = (
        addition(next(c for c in screened.candidates if c.effect == name), size)
        for name, size in (("coulomb_friction", 1.0), ("load_friction", 0.3))
    )
    refitter = Refitter(model, model.parameters(), (data,), known, {"max_iterations": 100})
    refits = Refits(refitter, fit, screened.noise, cylinders="assumed", tell=lambda _: None)
    refits.none(fit)
    (both,) = refits.tried((dry, of_load), None)
    assert depends_on_more(of_load, "speed")
    assert does_more(refits, both, of_load, "engine", "speed") is not tied
    assert not depends_on_more(dry, "speed")
    assert not does_more(refits, both, dry, "engine", "speed")
    # one name may well carry the mean of a function; a load that the speed tells does nothing beside it
    assert imitators(refits, both, "engine", "speed") == (1 if tied else 0)


@pytest.mark.parametrize(
    ("near", "share", "closed", "excluded"),
    [
        (0.8, 0.1, 0.93, False),  # a law there that closes most of fresh data
        (0.8, 0.1, 0.7, True),
        (0.99, 0.987, 0.97, False),  # a constant that leaves a fifth (rmse), of other motions too
        (0.99, 0.987, 0.9, True),
        (0.99, 0.83, 0.97, True),
    ],
)
def test_fresh_data_that_confirm_effects_say_how_near_they_come(near, share, closed, excluded):
    """A room whose temperature was stated 15 K too low: a constant power closed 99 % of the gap of both records."""
    assert UnknownLaw(None, 80.0, share, near=near).on_fresh(closed).excludes is excluded


@pytest.mark.parametrize(
    ("at", "odds", "course", "law"),
    [
        ("oil", None, "a curve", True),
        ("hose", None, "a curve", False),
        ("oil", None, None, False),
        ("oil", 0.5, "a curve", False),
        ("hose", 30.0, "a curve", True),
    ],
)
def test_what_is_left_at_the_port_of_an_effect_makes_it_a_part_of_a_law(at, odds, course, law):
    """A relief valve was "named": drag by the square of the pressure, eight times the noise beside it, and a function
    of the same pressure that was still missing."""
    unknown = Unknown("words", {}, at, "p", None, course, odds)
    effects = (SimpleNamespace(at="oil", members=("one",)),)
    assert in_its_place(unknown, effects) is law
    assert answer._verdict(effects, unknown) == ("class" if law else "named")
    assert not in_its_place(None, effects)
