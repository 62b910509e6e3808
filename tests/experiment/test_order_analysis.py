"""Order analysis against signals whose orders are known."""

import json
from dataclasses import replace

import numpy as np
import pytest

import casadi_engine as ce
from casadi_engine.errors import ExperimentError

PARTS = {0.5: (0.4, 1.0), 1: (0.3, -0.5), 2: (1.2, 2.5), 4: (0.05, 0.0)}  # order: (amplitude, phase)


def signal(theta, parts=None, mean=125.0):
    return mean + sum(a * np.cos(n * theta + p) for n, (a, p) in (parts or PARTS).items())


def run(theta, time, values=None, *, name="run", unit="rad/s", **more):
    return ce.Experiment.from_arrays(
        name,
        time=time,
        units={"theta": "rad", "omega": unit},
        theta=theta,
        omega=signal(theta) if values is None else values,
        **more,
    )


def steady(rpm=1200.0, cycles=4, rate=5000.0, **options):
    time = np.arange(round(cycles * 120 / rpm * rate) + 2) / rate
    theta = rpm * np.pi / 30 * time
    return run(theta, time, **options)


def assert_parts(found, row=0, rtol=1e-9):
    for order, (amplitude, phase) in PARTS.items():
        column = list(found.orders).index(order)
        assert found.amplitude[row, column] == pytest.approx(amplitude, rel=rtol)
        assert np.angle(np.exp(1j * (found.phase[row, column] - phase))) == pytest.approx(0, abs=10 * rtol)


def test_amplitudes_and_phases_of_a_steady_record():
    found = ce.orders(steady())
    assert found.orders.tolist() == [0.5 * k for k in range(1, 21)]
    assert_parts(found)
    others = [k for k, order in enumerate(found.orders) if order not in PARTS]
    assert found.amplitude[0, others].max() < 1e-9
    assert found.rpm == pytest.approx([1200.0])
    assert found.frequency_hz[0, 1] == pytest.approx(20.0)
    assert found.phasors[0, 1] == pytest.approx(0.3 * np.exp(-0.5j))


def test_a_record_need_not_hold_whole_cycles():
    time = np.arange(0.0163, 0.3737, 1 / 14402)
    theta = 2 + 131.7 * time
    assert_parts(ce.orders(run(theta, time)))


def test_a_run_up_has_a_row_for_each_lot_of_cycles():
    time = np.arange(0, 6, 1 / 8000)
    theta = 80 * time + 10 * time**2
    speed = 80 + 20 * time
    # in the crank angle the speed is nearly, not quite, linear over two cycles
    found = ce.orders(run(theta, time, speed + signal(theta, mean=0.0)), cycles=2)
    turned = theta[-1] / (4 * np.pi)
    assert len(found.rpm) == int(turned) // 2
    assert (np.diff(found.rpm) > 0).all()
    for row in (5, 12):
        assert_parts(found, row, rtol=0.03)
        inside = (theta > 8 * np.pi * row) & (theta < 8 * np.pi * (row + 1))
        assert found.rpm[row] == pytest.approx(speed[inside].mean() * 30 / np.pi, rel=1e-3)
        assert found.time[row] == pytest.approx(time[inside].mean(), abs=1e-3)


def test_a_trend_in_the_crank_angle_is_no_order():
    time = np.arange(0, 0.41, 1 / 5000)
    theta = 125.6 * time
    assert_parts(ce.orders(run(theta, time, signal(theta) + 0.7 * theta)))


def test_missing_samples_and_unequal_steps_do_no_harm():
    rng = np.random.default_rng(4)
    time = np.sort(rng.uniform(0, 0.5, 4000))
    theta = 125.6 * time + 0.02 * np.sin(30 * time)
    values = signal(theta)
    values[rng.uniform(size=values.size) < 0.3] = np.nan
    values[700:900] = np.nan
    assert_parts(ce.orders(run(theta, time, values)))


def test_a_two_stroke_engine_has_whole_orders_alone():
    found = ce.orders(steady(values=None, cycles=6), cycle_length=2 * np.pi, orders=(1, 2))
    assert found.orders.tolist() == [1, 2]
    with pytest.raises(ExperimentError, match=r"multiples of 1 \(one per engine cycle\)"):
        ce.orders(steady(), cycle_length=2 * np.pi, orders=(0.5,))


def test_standard_errors_are_the_scatter_of_the_amplitudes():
    time = np.arange(1500) / 3000
    theta = 140.0 * time
    exact = signal(theta)
    rng = np.random.default_rng(2)
    found = [
        ce.orders(run(theta, time, exact + 0.1 * rng.standard_normal(1500)), orders=(0.5, 1, 2))
        for _ in range(150)
    ]
    scatter = np.std([one.amplitude[0] for one in found], axis=0)
    claimed = np.mean([one.stderr[0] for one in found], axis=0)
    assert scatter == pytest.approx(claimed, rel=0.2)
    assert claimed == pytest.approx(0.1 * np.sqrt(2 / 1350), rel=0.1)  # five whole cycles of 5.6


def test_several_records_and_the_speed_of_a_resonance():
    runs = []
    for rpm in (1000, 1400, 1200, 1800):
        gain = 1 / abs(20.0**2 - (rpm / 60) ** 2 + 4j * rpm / 60) * 80
        time = np.arange(0, 0.6, 1 / 4000)
        theta = rpm * np.pi / 30 * time
        parts = {1: (gain, 0.0), 2: (0.5, 0.0)}
        runs.append(run(theta, time, signal(theta, parts), name=f"rpm_{rpm}"))
    found = ce.orders(runs)
    assert found.records == ("rpm_1000", "rpm_1400", "rpm_1200", "rpm_1800")
    assert found.peak(1) == pytest.approx((1200, 20))
    assert found.of(2) == pytest.approx([0.5] * 4)
    assert found.resonant == (1.0,)
    assert str(found).splitlines()[-1] == "order 1 peaks at 1200 RPM, 20.0 Hz: a resonance?"


def test_units_are_those_of_the_channel():
    found = ce.orders(steady().in_units({"omega": "rpm"}))
    assert found.unit == "rpm"
    assert found.of(1)[0] == pytest.approx(0.3 * 30 / np.pi)


def test_it_prints_one_screen_and_gives_plain_numbers():
    found = ce.orders(steady())
    lines = str(found).splitlines()
    assert lines[0] == "Orders of omega [rad/s]: 20 orders, 1 rows"
    assert lines[2].split()[:2] == ["run", "1200.0"]
    assert lines[-1] == "not shown: 14 weaker orders, 0 rows; ce.plot draws all"
    assert found._repr_html_().count("<tr>") == 2
    plain = json.loads(json.dumps(found.to_dict()))
    assert plain["amplitude"] == [found.amplitude[0].tolist()]
    long = ce.orders(steady(cycles=40), cycles=1)
    assert len(str(long).splitlines()) == 15
    assert "28 rows" in str(long)
    assert "a record with a name of…  1200.0" in str(
        ce.orders(steady(name="a record with a name of many words"))
    )


def test_the_result_cannot_be_changed():
    found = ce.orders(steady())
    with pytest.raises(ValueError, match="read-only"):
        found.amplitude[0, 0] = 1


@pytest.mark.parametrize(
    ("change", "options", "message"),
    [
        (lambda e: e.without("theta"), {}, r"experiment 'run' has no crank angle; seen: omega; .*theta="),
        (lambda e: e, {"theta": "crank"}, r"no crank angle; seen: theta, omega; allowed: a channel 'crank'"),
        (lambda e: e, {"channel": "speed"}, r"has no channel 'speed'"),
        (
            lambda e: e.between(0, 0.09),
            {},
            r"too short for an order analysis; seen: 0 whole .*give a longer record",
        ),
        (
            lambda e: e,
            {"cycles": 9},
            r"seen: 4 whole engine cycles of 12.57 rad; allowed: 9 or more; do: give cycles=4",
        ),
        (lambda e: e, {"cycles": 0}, r"cycles is not acceptable; seen: 0"),
        (lambda e: e, {"cycles": True}, r"cycles is not acceptable; seen: True"),
        (lambda e: e, {"orders": (0.3,)}, r"orders are not acceptable; seen: \(0.3,\); .*multiples of 0.5"),
        (lambda e: e, {"orders": 2}, r"orders are not acceptable; seen: 2"),
        (lambda e: e, {"orders": ()}, r"orders are not acceptable; seen: \(\)"),
        (lambda e: e, {"orders": (-1,)}, r"orders are not acceptable"),
        (
            lambda e: e,
            {"orders": (400,)},
            r"'run' has too few samples for order 400; seen: 2000 valid samples in 8 rev",
        ),
        (
            lambda e: e.resample(omega=500),
            {},
            r"'run' has too few samples for any order; seen: [45] valid samples",
        ),
        (lambda e: e, {"cycle_length": 0}, r"cycle_length is not positive"),
        (lambda e: 3, {}, r"there is nothing to analyse; seen: int"),
        (lambda e: [], {}, r"there is nothing to analyse; seen: no experiment"),
        (
            lambda e: [e, e.in_units({"omega": "rpm"})],
            {},
            r"different units in these records; seen: rad/s, rpm",
        ),
    ],
)
def test_what_cannot_be_analysed_is_said(change, options, message):
    with pytest.raises(ExperimentError, match=message):
        ce.orders(change(steady()), **options)


def test_a_speed_that_reverses_is_named():
    time = np.arange(0, 1, 1e-3)
    theta = 100 * np.sin(3 * time)
    with pytest.raises(
        ExperimentError, match=r"the crank angle 'theta' does not increase at 0\.525 s; .*turns back, cut"
    ):
        ce.orders(run(theta, time))


def test_a_gap_that_hides_the_orders_is_named():
    exp = steady(cycles=2)
    theta = exp["theta"].values % (4 * np.pi)
    exp = exp.masked("omega", theta < 1.5)
    with pytest.raises(ExperimentError, match="too few samples for 20 orders where samples are missing"):
        ce.orders(exp)


def test_an_order_that_was_not_analysed_is_named():
    found = ce.orders(steady(), orders=(1, 2))
    with pytest.raises(
        ExperimentError, match=r"that order was not analysed; seen: 3; allowed: 1, 2; .*orders="
    ):
        found.of(3)


def test_rounding_is_no_resonance():
    found, amplitude = ce.orders(steady(cycles=40), cycles=1), np.ones((40, 20))
    amplitude[:, 3] = 1e-13
    amplitude[20, [2, 3]] = 2.0, 9e-13
    assert replace(found, amplitude=amplitude, stderr=np.full((40, 20), 1e-14)).resonant == (1.5,)
