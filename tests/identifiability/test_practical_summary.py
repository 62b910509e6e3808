"""One screen each: information, profile, sweep, choice."""

from pathlib import Path

import numpy as np
import pytest

import casadi_engine as ce
from casadi_engine.identifiability import choose_experiments, fisher, loss_sweep, plan, profile
from casadi_engine.model import thesis_ties

DATA = Path(__file__).resolve().parents[2] / "data"
NOISE = ce.Noise(omega=0.1)


def fits_on_a_screen(text):
    lines = text.splitlines()
    assert len(lines) <= 45
    assert max(map(len, lines)) <= 100
    assert lines[-1].startswith(("Next:", "      ")) or any(line.startswith("Next:") for line in lines[-3:])


@pytest.fixture(scope="module")
def record():
    return ce.read_experiment(DATA / "misfire_1200rpm.csv.gz")


def test_information_of_a_crankshaft():
    model = ce.crankshaft(reciprocating_speed="measured")
    pars = thesis_ties(model.parameters())
    pars["C32"].set(vary=True)
    data = ce.read_experiment(DATA / "crankshaft" / "normal_1200rpm.csv.gz")
    text = str(fisher(model, data, parameters=pars, noise=NOISE))
    fits_on_a_screen(text)
    assert "Fisher information of crankshaft: 1 record, 14 400 samples" in text
    assert "hardly known" in text
    assert "give C32 a prior, fix or tie them, or look for a better experiment" in text
    assert "known to" in text


def test_information_of_two_masses(record):
    text = str(fisher(ce.two_mass(reciprocating_speed="measured"), record, noise=NOISE))
    fits_on_a_screen(text)
    assert text.count("well known") == 5
    assert "ce.profile(fit)" in text


def test_choices(record):
    model = ce.two_mass(reciprocating_speed="measured")
    normal = ce.read_experiment(DATA / "normal_1200rpm.csv.gz")
    plans = {
        "once more": plan(model, normal, duration=0.5),
        "cylinder 2 silent": plan(model, normal, misfire={2: "all"}, duration=0.5),
    }
    good = choose_experiments(model, plans, noise=NOISE, criterion={"C_el": 0.05, "K_el": 0.05}, size=2)
    text = str(good)
    fits_on_a_screen(text)
    assert good.chosen == ("cylinder 2 silent",)
    assert good.met
    assert "* cylinder 2 silent" in text
    assert "make cylinder 2 silent" in text
    poor = str(choose_experiments(model, plans, noise=NOISE, criterion={"C_el": 1e-4}, size=2))
    fits_on_a_screen(poor)
    assert "not all wanted errors are met: C_el would take" in poor
    for criterion, words in (("A", "mean square"), ("D", "volume"), ("E", "worst direction")):
        text = str(choose_experiments(model, plans, noise=NOISE, criterion=criterion, size=1))
        fits_on_a_screen(text)
        assert words in text


def test_profiles_and_sweeps(record):
    model = ce.two_mass(reciprocating_speed="measured")
    short = record.between(0, 0.3)
    fit = ce.estimate(model, short, noise=NOISE, progress=False)
    text = str(profile(fit, "K_el", points=2))
    fits_on_a_screen(text)
    assert "parabola" in text
    assert "95 % intervals" in text
    swept = loss_sweep(model, short, "K_el", points=5)
    fits_on_a_screen(str(swept))
    assert "U-shape" in str(swept)
    assert np.isfinite(swept.loss["K_el"]).all()
