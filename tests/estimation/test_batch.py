"""Fits in several processes and on a cluster: the numbers of one process, in its order."""

import importlib

import numpy as np
import pytest

import casadi_engine as ce
from casadi_engine.errors import EstimationError, ParameterError
from casadi_engine.estimation.batch import Task, fits
from casadi_engine.estimation.study import study


def tasks_of(run_up, count=4):
    model = ce.one_inertia()
    return [Task(model, run_up(seed=seed), {"noise": ce.Noise(omega=0.05)}) for seed in range(count)]


def same(found, expected):
    """The same answers, but for the last digits of a sum that another process adds up in another order."""
    for one, other in zip(found, expected, strict=True):
        assert one.status == other.status == "converged"
        assert one.values == pytest.approx(other.values, rel=1e-9)
        assert one.stderr == pytest.approx(other.stderr, rel=1e-7)
        assert one.messages == other.messages
        assert str(one.model) == str(other.model)
        for record, traces in one.traces.items():
            for name, trace in traces.items():
                twin = other.traces[record][name].residual
                assert np.allclose(trace.residual, twin, rtol=0, atol=1e-9, equal_nan=True)
        assert [o.starts for o in one.optima] == [o.starts for o in other.optima]
        for optimum, twin in zip(one.optima, other.optima, strict=True):
            assert optimum.cost == pytest.approx(twin.cost, rel=1e-10)
            assert optimum.status == twin.status


@pytest.fixture(scope="module")
def cluster():
    """A dask cluster of two processes on this machine."""
    distributed = pytest.importorskip("distributed", reason="the cluster needs the extra cluster")
    import dask

    patience = {"distributed.comm.timeouts.connect": "120s", "distributed.comm.timeouts.tcp": "120s"}
    with dask.config.set(patience), _started(distributed) as made, distributed.Client(made, timeout=120):
        yield made


def _started(distributed, attempts=3):
    """The cluster; on a busy machine its processes may come too late at first."""
    while True:
        attempts -= 1
        try:
            return distributed.LocalCluster(
                n_workers=2, threads_per_worker=1, processes=True, dashboard_address=None, memory_limit=None
            )
        except (RuntimeError, TimeoutError):
            if not attempts:
                raise


def drawn(piece):
    """One fit of a study, as plain numbers; its record is made in the worker."""
    rng, time = np.random.default_rng(piece["seed"]), 0.02 * np.arange(200)
    speed = 20 * np.exp(-time / 0.8) + 0.05 * rng.standard_normal(200)
    units = {"T": "N m", "omega": "rad/s"}
    data = ce.Experiment.from_arrays(
        "coast", time=time, units=units, hold="zero", T=np.zeros(200), omega=speed
    )
    parameters = ce.one_inertia().parameters()
    parameters.fix("C_eng", 0.5)
    fit = ce.estimate(
        ce.one_inertia(), data, parameters=parameters, noise=ce.Noise(omega=0.05), progress=False
    )
    return {"J_eng": fit.values["J_eng"], "stderr": fit.stderr["J_eng"], "cost": fit.cost}


@pytest.mark.slow
def test_a_dask_cluster_finds_the_numbers_of_one_process(cluster, run_up, shaft, shaft_model, tmp_path):
    import joblib

    tasks = tasks_of(run_up)
    pieces = [{"seed": seed} for seed in range(6)]
    several = {"noise": ce.Noise(omega=0.05, omega_load=0.1), "starts": 5, "seed": 2, "progress": False}
    with joblib.parallel_config(backend="dask"):
        found = fits(tasks, jobs=None)
        rows = study(drawn, pieces, jobs=None, checkpoint=tmp_path / "study.jsonl")
        far = ce.estimate(shaft_model(), shaft().data, jobs=None, **several)
        # an error of a worker arrives as it was raised there
        with pytest.raises(ParameterError, match="unknown parameter") as caught:
            study(_no_such_parameter, pieces, jobs=None)
    assert "J_eng" in caught.value.allowed
    same(found, fits(tasks))
    for row, twin in zip(rows, study(drawn, pieces), strict=True):
        assert row == pytest.approx(twin, rel=1e-9)
    same([far], [ce.estimate(shaft_model(), shaft().data, **several)])


def test_processes_find_the_numbers_of_one(run_up):
    pytest.importorskip("joblib", reason="several processes need joblib")
    tasks = tasks_of(run_up)
    same(fits(tasks, jobs=2), fits(tasks))


def test_a_task_that_fails_has_its_error_in_its_place(run_up):
    good, other = tasks_of(run_up, 2)
    bad = Task(good.model, good.data, {"noise": ce.Noise(omega=0.05), "starts": 0})
    found = fits([good, bad, other])
    assert isinstance(found[1], EstimationError)
    assert "starts is not acceptable" in str(found[1])
    assert found[0].converged
    assert found[2].converged


def test_starts_in_processes_end_where_they_end_in_one(shaft, shaft_model):
    pytest.importorskip("joblib", reason="several processes need joblib")
    parameters = shaft_model().parameters()
    parameters.tie("C_eng", "0.75*C_el")
    parameters.constrain("J_eng + J_load", 0.1, 2.0)
    options = {
        "parameters": parameters,
        "noise": ce.Noise(omega=0.05, omega_load="estimate"),
        "progress": False,
    }
    options |= {"starts": 4, "neighbours": 1, "seed": 5}
    seen = []
    one = ce.estimate(shaft_model(), shaft().data, **options)
    two = ce.estimate(
        shaft_model(), shaft().data, jobs=2, **options | {"progress": lambda *report: seen.append(report)}
    )
    same([two], [one])
    assert sum(o.starts for o in two.optima) == 6
    assert len(seen) >= 6  # one report for each search, and for last steps on all samples
    assert one.options["starts"] == two.options["starts"]


def test_a_start_at_which_the_model_fails_is_passed_over_in_processes_too(line, line_data):
    pytest.importorskip("joblib", reason="several processes need joblib")
    b = ce.Blueprint("root")
    p, x, u = b.parameter("p", 0.5, min=-1, max=1), b.state("x"), b.input("u1")
    b.ode("x", p**0.5 * u)
    b.output("y", x)
    model, data = b.model(), line_data(p=(0.7, 0.0)).data
    options = {"noise": ce.Noise(y=0.1), "starts": 6, "progress": False}
    one, two = ce.estimate(model, data, **options), ce.estimate(model, data, jobs=2, **options)
    same([two], [one])
    assert sum(o.starts for o in two.optima) < 6


def test_starts_that_all_fail_are_an_error_in_processes_too(line_data):
    pytest.importorskip("joblib", reason="several processes need joblib")
    b = ce.Blueprint("root")
    p, x, u = b.parameter("p", -0.5, min=-1, max=-0.1), b.state("x"), b.input("u1")
    b.ode("x", p**0.5 * u)
    b.output("y", x)
    for jobs in (1, 2):
        with pytest.raises(EstimationError, match="cannot be evaluated at the start values"):
            ce.estimate(
                b.model(), line_data().data, noise=ce.Noise(y=0.1), starts=3, jobs=jobs, progress=False
            )


@pytest.mark.parametrize("jobs", [0, -1, 1.5, True])
def test_a_number_of_processes_that_cannot_be_is_refused(run_up, refused, jobs):
    with refused(
        EstimationError, "jobs is not acceptable", seen=str(jobs), allowed=">= 1", cure="leave jobs out"
    ):
        ce.estimate(ce.one_inertia(), run_up(), jobs=jobs)
    with refused(EstimationError, "jobs is not acceptable", seen=str(jobs)):
        fits(tasks_of(run_up), jobs=jobs)


def test_work_that_cannot_be_sent_is_named(refused):
    pytest.importorskip("joblib", reason="several processes need joblib")
    lock = __import__("threading").Lock()
    with refused(
        EstimationError, "cannot be sent to another process", seen="lock", allowed="imported", cure="jobs"
    ):
        study(lambda piece: lock.acquire() and piece, [1, 2, 3], jobs=2)


def test_work_that_cannot_be_received_is_named(refused):
    pytest.importorskip("joblib", reason="several processes need joblib")

    class Lost:
        def __reduce__(self):
            return importlib.import_module, ("a_module_of_this_process_alone",)

        def __call__(self, piece):
            return piece

    with refused(EstimationError, "cannot be sent to another process", seen="un-serialize", cure="a module"):
        study(Lost(), [1, 2, 3], jobs=2)


def _no_such_parameter(piece):
    return ce.one_inertia().parameters()["J_engine"].value


@pytest.mark.parametrize("tasks", [3, [3], "ab"])
def test_what_is_no_task_is_refused(refused, tasks):
    with refused(
        EstimationError, "a task of a batch", seen="3" if tasks != "ab" else "'a'", cure="Task(model"
    ):
        fits(tasks)


def test_options_that_estimate_does_not_have_are_the_tasks_error(run_up):
    model, data = ce.one_inertia(), run_up(seed=0)
    strange, none, good = fits([Task(model, data, {"nois": 1}), Task(model, data, 3), Task(model, data)])
    assert isinstance(strange, EstimationError)
    assert "estimate has no such option; seen: 'nois'" in str(strange)
    assert "noise" in strange.allowed
    assert isinstance(none, EstimationError)
    assert "the options of a fit are not a mapping; seen: 3" in str(none)
    assert good.converged
