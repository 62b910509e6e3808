"""posterior: against quadrature, and what it refuses."""

import json
import re
from dataclasses import replace
from importlib import import_module
from types import SimpleNamespace

import numpy as np
import pytest
from scipy.special import ndtr, ndtri

import casadi_engine as ce
from casadi_engine.errors import PosteriorError, UntrustedPosteriorError
from casadi_engine.posterior.result import Posterior
from casadi_engine.posterior.target import Target, root_of

SIGMA = 0.02


def by_quadrature(record, closed_form, likelihood, count=81):
    """Mean and standard deviation of inertia and damper, and the log evidence, with uniform cells."""
    one, two = np.linspace(0.392, 0.410, count), np.linspace(0.494, 0.506, count)
    logs = np.array([[closed_form(record, a, b, SIGMA, likelihood) for b in two] for a in one])
    # flat in log J from 1e-6 to 1e3 and in C from 0 to 1e5
    density = logs - np.log(one)[:, None] - np.log(np.log(1e9)) - np.log(1e5) - 100 * np.log(2 * np.pi)
    top = density.max()
    weight = np.exp(density - top)
    evidence = top + np.log(weight.sum() * (one[1] - one[0]) * (two[1] - two[0]))
    weight /= weight.sum()
    means = [float(weight.sum(axis=1) @ one), float(weight.sum(axis=0) @ two)]
    spreads = [
        np.sqrt(weight.sum(axis=1) @ (one - means[0]) ** 2),
        np.sqrt(weight.sum(axis=0) @ (two - means[1]) ** 2),
    ]
    return means, spreads, evidence


def test_mean_spread_and_evidence_are_those_of_quadrature(run_up, closed_form, post):
    means, spreads, evidence = by_quadrature(run_up(), closed_form, Target(post.fit).likelihood)
    found = post
    for name, mean, spread in zip(("J_eng", "C_eng"), means, spreads, strict=True):
        assert found[name].mean() == pytest.approx(mean, abs=4 * spread / np.sqrt(1000))
        assert found[name].std() == pytest.approx(spread, rel=0.1)
    assert found.log_evidence == pytest.approx(evidence, abs=4 * found.log_evidence_error + 0.02)
    assert found.log_evidence_error < 0.05


@pytest.mark.parametrize("gap", [False, pytest.param(True, marks=pytest.mark.slow)])
def test_an_unknown_noise_level_is_part_of_it(run_up, gap):
    found = ce.posterior(ce.estimate(ce.one_inertia(), run_up(gap=gap), progress=False))
    count = 190 if gap else 200
    sigma = found["sigma(omega)"]
    assert sigma.std() / sigma.mean() == pytest.approx(1 / np.sqrt(2 * (count - 3)), rel=0.15)
    assert sigma.mean() == pytest.approx(found.fit.noise["omega"][0], rel=0.01)
    assert "sigma(omega)" in str(found)


@pytest.mark.slow  # each is held against closed forms of its own
def test_ensemble_and_importance_sampling_agree(fit, post):
    pytest.importorskip("emcee")
    walked = ce.posterior(fit, method="ensemble", evaluations=9_000)
    assert walked.method == "ensemble"
    assert max(walked.rhat.values()) <= 1.02
    for name in post.names:
        spread = post[name].std()
        assert np.median(walked[name]) == pytest.approx(np.median(post[name]), abs=0.2 * spread)
        assert walked[name].std() == pytest.approx(spread, rel=0.15)
    error = np.hypot(walked.log_evidence_error, post.log_evidence_error)
    assert walked.log_evidence == pytest.approx(post.log_evidence, abs=4 * error)
    assert "R-hat" in walked.table()
    assert walked.to_inference_data()["posterior"]["J_eng"].shape[0] > 4


def test_the_same_seed_gives_the_same_draws(fit, post):
    assert np.array_equal(ce.posterior(fit).values, post.values)
    assert not np.array_equal(ce.posterior(fit, seed=1, draws=100).values[:10], post.values[:10])


def test_bounds_ties_and_constraints_hold(run_up):
    pars = ce.one_inertia().parameters()
    pars["C_eng"].set(0.6, min=0.5, max=1.0)  # half of the density is beyond
    bounded = ce.posterior(
        ce.estimate(ce.one_inertia(), run_up(), parameters=pars, noise=ce.Noise(omega=SIGMA), progress=False)
    )
    assert bounded["C_eng"].min() >= 0.5
    assert bounded["C_eng"].max() < 0.51
    pars = ce.one_inertia().parameters()
    pars.constrain("C_eng/J_eng", min=1.247, max=2.0)
    held = ce.posterior(
        ce.estimate(ce.one_inertia(), run_up(), parameters=pars, noise=ce.Noise(omega=SIGMA), progress=False)
    )
    assert (held["C_eng"] / held["J_eng"]).min() >= 1.247 - 1e-5
    pars = ce.one_inertia().parameters()
    pars.tie("C_eng", "1.25*J_eng")
    tied = ce.posterior(
        ce.estimate(ce.one_inertia(), run_up(), parameters=pars, noise=ce.Noise(omega=SIGMA), progress=False)
    )
    assert tied.names == ("J_eng",)
    assert tied["J_eng"].std() < 0.001


def test_an_optimum_in_a_corner_of_its_bounds_is_drawn_from(run_up):
    pars = ce.one_inertia().parameters()
    pars["J_eng"].set(0.45, min=0.4405, max=5)
    pars["C_eng"].set(0.4, min=0.0, max=0.47)
    fit = ce.estimate(ce.one_inertia(), run_up(), parameters=pars, noise=ce.Noise(omega=0.02), progress=False)
    assert fit.estimates["C_eng"].at_bound
    # what the bounds leave is larger than stated, which is not asked here
    found = ce.posterior(replace(fit, own_noise={}), method="importance")
    assert found["J_eng"].min() >= 0.4405
    assert found["C_eng"].max() <= 0.47
    assert found.interval("C_eng", 0.5)[0] > 0.469


def test_a_normal_prior_counts_once(run_up, closed_form, post):
    pars = ce.one_inertia().parameters()
    pars["J_eng"].set(prior=(0.41, 0.001))
    found = ce.posterior(
        ce.estimate(ce.one_inertia(), run_up(), parameters=pars, noise=ce.Noise(omega=SIGMA), progress=False)
    )
    (mean, _), (spread, _), _ = by_quadrature(run_up(), closed_form, Target(post.fit).likelihood)
    weight = np.array([spread**-2, 0.001**-2])
    assert found["J_eng"].mean() == pytest.approx(weight @ [mean, 0.41] / weight.sum(), abs=2e-4)
    assert found["J_eng"].std() == pytest.approx(weight.sum() ** -0.5, rel=0.1)


def test_a_nonlinear_model_has_one_too(monkeypatch):
    monkeypatch.setattr(import_module("casadi_engine.posterior.importance"), "EACH", 50)
    blueprint = ce.Blueprint("drag")
    speed = blueprint.state("v", scale=10.0)
    drag, push = blueprint.parameter("k", 0.02, min=1e-4, max=1.0), blueprint.input("F")
    blueprint.ode("v", push - drag * speed**2)
    blueprint.output("v_out", speed)
    model = blueprint.model()
    time = np.linspace(0, 4, 81)
    made = ce.Experiment.from_arrays("run", time=time, units={"F": "1"}, F=np.full(81, 4.0))
    clean = ce.simulate(model, made, initial={"v": 3.0})["v_out"].values
    noisy = clean + 0.1 * np.random.default_rng(0).standard_normal(81)
    record = ce.Experiment.from_arrays(
        "run", time=time, units={"F": "N", "v_out": "m/s"}, F=np.full(81, 4.0), v_out=noisy
    )
    fit = ce.estimate(model, record, noise=ce.Noise(v_out=0.1), progress=False)
    found = ce.posterior(fit, draws=400)
    assert found.bins is None
    assert found["k"].std() == pytest.approx(fit.stderr["k"], rel=0.15)
    assert found["k"].mean() == pytest.approx(fit.values["k"], abs=0.2 * fit.stderr["k"])


# ---- what is refused


def test_only_a_converged_fit_has_a_posterior(run_up, fit):
    with pytest.raises(PosteriorError, match="a posterior needs a fit; seen: str"):
        ce.posterior("fit")
    early = ce.estimate(
        ce.one_inertia(), run_up(gap=True), max_iterations=1, noise=ce.Noise(omega=SIGMA), progress=False
    )
    with pytest.raises(PosteriorError, match=r"needs a fit that converged.*seen: not converged"):
        ce.posterior(early)
    pars = ce.one_inertia().parameters()
    for name in pars.names:
        pars.fix(name)
    none = ce.estimate(
        ce.one_inertia(), run_up(), parameters=pars, noise=ce.Noise(omega=SIGMA), progress=False
    )
    with pytest.raises(PosteriorError, match="seen: no free parameter"):
        ce.posterior(none)


def test_a_robust_loss_or_a_predictor_is_refused(run_up):
    robust = ce.estimate(ce.one_inertia(), run_up(), loss="huber", progress=False)
    with pytest.raises(PosteriorError, match="needs the likelihood of normal noise; seen: loss=huber"):
        ce.posterior(robust)
    predicted = ce.estimate(
        ce.one_inertia(), run_up(), noise=ce.Noise(omega=0.1, gain=[[0.5]]), progress=False
    )
    with pytest.raises(PosteriorError, match="a predictor is not available; seen: a gain, stated"):
        ce.posterior(predicted)


def test_a_direction_that_the_data_leave_open_is_refused(run_up):
    record = run_up()
    still = ce.Experiment.from_arrays(
        "coast", time=record["omega"].time, units={"T": "N m", "omega": "rad/s"}, hold="zero",
        T=np.zeros(200), omega=100 * np.exp(-1.25 * record["omega"].time),
    )  # fmt: skip
    fit = ce.estimate(ce.one_inertia(), still, noise=ce.Noise(omega=0.02), progress=False)
    with pytest.raises(
        PosteriorError, match=r"leave a direction of the parameters open.*seen: .*J_eng.*do: fix one"
    ):
        ce.posterior(fit)


def test_parameters_without_bounds_are_refused(run_up):
    pars = ce.one_inertia().parameters()
    pars["C_eng"].set(max=np.inf)
    fit = ce.estimate(
        ce.one_inertia(), run_up(), parameters=pars, noise=ce.Noise(omega=SIGMA), progress=False
    )
    with pytest.raises(PosteriorError, match=r"without bounds have no posterior; seen: C_eng from 0 to inf"):
        ce.posterior(fit)


def test_data_without_noise_are_refused():
    time = np.arange(60) * 0.05
    exact = ce.Experiment.from_arrays(
        "exact", time=time, units={"T": "N m", "omega": "rad/s"}, hold="zero", T=np.full(60, 2.0),
        omega=4 * (1 - np.exp(-time / 0.8)),
    )  # fmt: skip
    fit = ce.estimate(ce.one_inertia(), exact, progress=False)
    with pytest.raises(PosteriorError, match=r"to rounding.*seen: sigma\(omega\) = .*do: state the noise"):
        ce.posterior(fit)


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({"method": "guess"}, "method"),
        ({"draws": 3}, "draws"),
        ({"seed": -1}, "seed"),
        ({"evaluations": 10}, "evaluations"),
        ({"progress": "loud"}, "invalid `progress`; seen: 'loud'"),
    ],
)
def test_options_that_do_not_fit_are_refused(fit, options, words):
    with pytest.raises(ce.CasadiEngineError, match=words):
        ce.posterior(fit, **options)


def test_draws_that_cannot_be_trusted_are_no_answer(fit, monkeypatch):
    from casadi_engine.posterior import ensemble, importance

    monkeypatch.setattr(importance, "FEWEST", 1e9)
    monkeypatch.setattr(importance, "EACH", 30)
    with pytest.raises(
        UntrustedPosteriorError, match=r"importance sampling does not describe.*seen: .*k-hat"
    ):
        ce.posterior(fit, method="importance")
    pytest.importorskip("emcee")
    monkeypatch.setattr(ensemble, "FEWEST", 1e9)
    with pytest.raises(
        UntrustedPosteriorError, match=r"walkers of the ensemble do not agree.*evaluations=4000"
    ):
        ce.posterior(fit, evaluations=1000)
    assert UntrustedPosteriorError.exit_code == 3


def test_draws_of_which_all_data_leave_a_few_are_no_answer(fit, monkeypatch):
    """Worth 5 independent ones they had been given, where a fit was at the poorer of two optima."""
    module = import_module("casadi_engine.posterior.posterior")
    plain, tried = module.with_all_data, []

    def few(target, drawn, random, nearer):
        tried.append(1)
        drawn, scatter = plain(target, drawn, random, nearer)
        return replace(drawn, tail=drawn.tail * 90 / drawn.tail.min()), scatter

    monkeypatch.setattr(module, "with_all_data", few)
    with pytest.raises(UntrustedPosteriorError, match="all data say leaves too few of the draws") as told:
        ce.posterior(fit)
    assert "draws worth 90 independent ones" in str(told.value)
    assert "estimate(..., starts=10)" in str(told.value)
    assert len(tried) == len(module.LEFT_OUT)  # with less left out, and with nothing


def test_where_the_model_has_no_value_is_said(fit, monkeypatch):
    def broken(*_args, **_kwargs):
        raise FloatingPointError("the linear core is not finite here")

    monkeypatch.setattr(import_module("casadi_engine.posterior.posterior"), "_met", broken)
    with pytest.raises(
        PosteriorError, match="the model has no value there: the linear core is not finite here"
    ):
        ce.posterior(fit)


def test_a_parameter_that_a_bound_alone_holds_is_looked_at_between_its_bounds():
    """Its error is as large as numbers go: a look that far away had ended in a bare FloatingPointError."""
    time = np.arange(40.0)
    b = ce.Blueprint("pot")
    c, r = b.parameter("C", 10.0, min=1, max=100), b.parameter("R", 1.0, min=0.01, max=1e3)
    t, heat = b.state("T"), b.input("P")
    b.ode("T", (heat - t / r) / c)
    b.output("y", t)
    random = np.random.default_rng(0)
    power = np.where(time < 3, 1.0, 0.0)
    y = np.minimum(time, 3) / 10 + 0.05 * random.standard_normal(40)
    data = ce.Experiment.from_arrays("r", time=time, units={"P": "1", "y": "1"}, hold="zero", P=power, y=y)
    fit = ce.estimate(b.model(), data, noise=ce.Noise(y=0.05), progress=False)
    post = ce.posterior(fit)
    assert post.interval("R", 0.95)[1] <= 1e3


def test_progress_is_told(fit):
    told = []
    ce.posterior(fit, draws=100, progress=lambda words, count: told.append((words, count)))
    assert [words for words, _ in told] == [
        "looking for optima",
        "importance sampling",
        "looking at all data",
    ]
    assert told[0][1] == 0 < told[-1][1]


@pytest.mark.parametrize("when", ["looking for optima", "importance sampling", "looking at all data"])
def test_ctrl_c_is_no_answer_and_says_where_it_came(fit, when):
    def stop(words, _):
        if words == when:
            raise KeyboardInterrupt

    with pytest.raises(UntrustedPosteriorError, match=rf"stopped before.*Ctrl-C while {when}, after \d+"):
        ce.posterior(fit, draws=100, progress=stop)


def test_more_draws_are_worth_more(fit):
    assert min(ce.posterior(fit, draws=4000).bulk.values()) > 3500


# ---- what it says


def test_it_prints_one_screen(post):
    text = str(post)
    assert text.startswith("Posterior of 2 parameters given 1 record: 1000 draws, importance")
    assert "one mode, found by" in text
    assert (
        "prior: flat in the logarithm between the bounds: J_eng; flat in the value between the bounds: C_eng"
        in text
    )
    assert "quality: Pareto k-hat" in text
    assert max(map(len, text.splitlines())) < 150
    assert len(text.splitlines()) < 30


def test_it_says_of_what_the_records_tell_hardly_anything(run_up):
    pars = ce.one_inertia().parameters()
    pars["J_eng"].set(0.4, min=0.3999, max=0.4001)
    pars["C_eng"].set(0.5, min=0.0, max=2.0)
    fit = ce.estimate(
        ce.one_inertia(), run_up(), parameters=pars, noise=ce.Noise(omega=SIGMA), progress=False
    )
    text = str(ce.posterior(fit))
    assert "the records tell hardly anything of J_eng: intervals are the prior's" in text


def test_it_says_where_the_fit_ended_at_a_poor_optimum(post):

    assert "outside all draws" not in str(post)
    estimates = dict(post.fit.estimates)
    estimates["J_eng"] = replace(estimates["J_eng"], value=9.0)
    moved = replace(post, fit=replace(post.fit, estimates=estimates))
    assert "the fit's J_eng lies outside all draws: a better optimum was met" in str(moved)
    held = replace(estimates["J_eng"], at_bound="max")
    moved = replace(post, fit=replace(post.fit, estimates=estimates | {"J_eng": held}))
    assert "outside all draws" not in str(moved)


def test_a_residual_of_its_own_counts_by_a_root_of_the_likelihood(post):
    """Intervals under which "4.8 times too narrow" stood, and 100 % for a wrong model, were made of white noise."""
    assert (post.root, post.untold_states) == (1.0, (0, 1))
    assert "divided by" not in str(post)
    coloured = ce.posterior(replace(post.fit, own_noise={"J_eng": 1.5, "C_eng": 3.0}))
    assert coloured.root == 9.0
    for name in ("J_eng", "C_eng"):
        assert coloured[name].std() == pytest.approx(3.0 * post[name].std(), rel=0.15)
        assert np.median(coloured[name]) == pytest.approx(np.median(post[name]), abs=0.5 * post[name].std())
    said = str(coloured)
    assert "divided by 9, so that the interval of C_eng is as wide as its error in the fit asks" in said
    assert "those of others may be up to 2 times too wide" in said
    assert post.evidence_at(9.0) == pytest.approx(coloured.log_evidence, abs=0.15)
    assert coloured.evidence_at(1.0) == pytest.approx(post.log_evidence, abs=0.15 * 9)
    hardly = replace(post.fit, own_noise={"J_eng": 1.05})
    assert root_of(hardly) == 1.0


def test_it_says_where_records_do_not_tell_the_states(post):
    untold = replace(post, untold_states=(9, 13))
    assert "the records hardly tell 9 of 13 directions of their initial states" in str(untold)


def test_an_interval_begins_at_a_bound_from_which_the_density_falls(post):
    """Equal tails left a true 0 out of every 95 % interval where the density is highest at the bound 0."""
    random, k = np.random.default_rng(3), post.names.index("C_eng")
    count = len(post.values)
    assert post.fit.parameters["C_eng"].min == 0

    def with_draws(own):
        values = post.values.copy()
        values[:, k] = own
        return replace(post, values=values)

    falling = random.exponential(2.0, count)
    low, high = with_draws(falling).interval("C_eng")
    assert low == 0.0
    assert np.mean(falling <= high) == pytest.approx(0.95, abs=1e-3)
    inside = 5 + random.standard_normal(count)
    assert with_draws(inside).interval("C_eng") == pytest.approx(np.quantile(inside, [0.025, 0.975]))
    held = np.abs(1.0 + random.standard_normal(count))  # its density at the bound is half of the highest
    assert with_draws(held).interval("C_eng")[0] == 0.0
    assert with_draws(held).interval("C_eng", 0.3)[0] > 0.3
    flat = random.uniform(0, post.fit.parameters["C_eng"].max, count)
    assert with_draws(flat).interval("C_eng")[0] > 0.0


def test_intervals_are_quantiles_of_the_draws(post):
    low, high = post.interval("J_eng", 0.8)
    assert np.mean((post["J_eng"] >= low) & (post["J_eng"] <= high)) == pytest.approx(0.8, abs=0.005)
    assert low < post.median["J_eng"] < high
    with pytest.raises(PosteriorError, match=r"no such parameter; seen: 'J'; allowed: .*J_eng"):
        post.interval("J")
    with pytest.raises(PosteriorError, match="the level of the intervals is not acceptable"):
        post.interval("J_eng", 95)


def test_it_becomes_plain_data(post):
    document = json.loads(json.dumps(post.to_dict(), allow_nan=False))
    assert document["intervals"]["J_eng"]["95"] == list(post.interval("J_eng", 0.95))
    assert len(document["draws"]["C_eng"]) == 1000
    assert document["modes"][0]["mass"] == 1.0
    data = post.to_inference_data()
    assert data["posterior"]["J_eng"].shape == (1, 1000)
    assert data["sample_stats"]["lp"].shape == (1, 1000)


def test_the_prediction_holds_the_truth(post, run_up):
    ahead = post.predictive(draws=40)
    truth = 4 * (1 - np.exp(-ahead.time / 0.8))
    low, high = ahead.band("omega", 0.99)
    assert np.mean((truth > low - 2e-3) & (truth < high + 2e-3)) > 0.95
    wide_low, wide_high = ahead.band("omega", noise=True)
    measured = ahead.measured["omega"]
    assert np.mean((measured > wide_low) & (measured < wide_high)) == pytest.approx(0.95, abs=0.04)
    assert (wide_high - wide_low).mean() == pytest.approx(4 * 0.02, rel=0.15)
    said = str(ahead)
    assert said.startswith(f"Prediction of {ahead.record} with 95 % bands, from 40 draws of the posterior")
    assert re.search(
        r"omega: half width [\d.]+ \(median\), .* rad/s; with noise it holds 9\d % of the samples", said
    )
    assert "array" not in said
    other = post.predictive(run_up(seed=5), draws=5)
    assert other.runs["omega"].shape == (5, 200)
    with pytest.raises(PosteriorError, match="no such output; seen: 'speed'; allowed: omega"):
        ahead.band("speed")
    with pytest.raises(PosteriorError, match="no record to predict; seen: str"):
        post.predictive("run")


def test_an_equality_is_to_be_a_tie(run_up):
    pars = ce.one_inertia().parameters()
    pars.constrain("C_eng/J_eng", min=1.25, max=1.25)
    fit = ce.estimate(
        ce.one_inertia(), run_up(), parameters=pars, noise=ce.Noise(omega=SIGMA), progress=False
    )
    with pytest.raises(PosteriorError, match=r"leaves no room to draw from.*C_eng/J_eng == 1.25.*pars.tie"):
        ce.posterior(fit)


class _Drawn:
    """As much of a posterior as its intervals ask for: draws of one number that is flat in 0 to 1."""

    names = ("a",)

    def __init__(self, own):
        self.values, self.bulk = own[:, None], {"a": float(len(own))}
        self.prior = SimpleNamespace(
            low=np.zeros(1), bounds=lambda _: (0.0, 1.0), along=lambda _, v: np.asarray(v)
        )

    def __getitem__(self, _):
        return self.values[:, 0]

    _is_denser = Posterior._is_denser


@pytest.mark.parametrize("sigma", [0.1, 0.3, 1.0])
def test_intervals_hold_what_they_say_beside_a_bound(sigma):
    """The side is chosen by the draws, and the true value is drawn from the prior."""
    random, count = np.random.default_rng(7), 1500
    truth = random.uniform(0, 1, count)
    seen = truth + sigma * random.standard_normal(count)
    held = {0.5: 0, 0.95: 0}
    for true, y in zip(truth, seen, strict=True):
        ends = ndtr((np.array([0.0, 1.0]) - y) / sigma)
        own = _Drawn(y + sigma * ndtri(random.uniform(*ends, 500)))
        for level in held:
            low, high = Posterior.interval(own, "a", level)
            held[level] += low <= true <= high
    assert held[0.95] / count == pytest.approx(0.95, abs=0.018)
    assert held[0.5] / count == pytest.approx(0.5, abs=0.04)
