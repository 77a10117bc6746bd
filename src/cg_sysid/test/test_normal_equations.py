"""The step of an identification, from normal equations of very different size."""

from types import SimpleNamespace

import numpy as np
import pytest
from hanging_arm import nominal, recorded

from cg_dynamics.model import Model
from cg_dynamics.rig import Setup, Spring
from cg_sysid.experiments.rehearsal import rehearse
from cg_sysid.identification import descent, identify
from cg_sysid.identification.data_set import prepare
from cg_sysid.identification.identify import _guesses, fit
from cg_sysid.identification.simulation_error import (
    SPOILT,
    Border,
    Point,
    Problem,
    attempt,
    follow,
    reduced,
    settled,
    solve,
)
from cg_sysid.identification.uncertainty import _widening
from cg_sysid.identification.unknowns import unknowns_of


def _point(own_hessian, coupling, own_gradient):
    nothing = np.zeros((1, 1))
    return Point(
        cost=1.0, shared_hessian=np.array([[7.0]]), shared_gradient=np.array([3.0]),
        own=[(own_hessian, coupling, own_gradient)], sse=nothing, count=nothing, data_cost=1.0,
        border=Border(0.0, np.zeros(1), nothing),
    )  # fmt: skip


def test_reduced_is_the_schur_complement():
    d, e, g = np.array([[4.0, 1.0], [1.0, 9e6]]), np.array([[2.0], [5e2]]), np.array([0.5, 8e2])
    h, gradient, _ = reduced(_point(d, e, g), 0.0)
    whole = np.block([[d, e], [e.T, np.array([[7.0]])]])
    step = np.linalg.solve(whole, np.append(g, 3.0))[2]
    # Both are solves of a matrix with condition 1e7: nine digits are left of sixteen.
    assert (gradient / h[0, 0])[0] == pytest.approx(step, rel=1e-9)


def test_a_robot_without_a_border_of_consistency_has_the_curvature_of_its_sensitivities():
    believed = nominal()
    data_sets = prepare(believed, [recorded(believed, 2.0, 1)])
    unknowns = unknowns_of(believed)
    problem = Problem(believed, data_sets, unknowns, _guesses(believed, data_sets, {}), 1.0)
    values = np.array([u.prior for u in unknowns])
    theta = np.array([u.to_coordinate(v) for u, v in zip(unknowns, values, strict=True)])
    motion = problem.guesses[0]
    point = attempt(problem, theta, [motion], np.inf).point(1.0)
    _, _, jacobian = follow(problem, 0, values, motion, np.inf).normal(keep=True)
    shared = jacobian[:, :, len(motion) :] / data_sets[0].sigma[:, None] * problem.chain(values)
    shared = shared.reshape(-1, len(unknowns))
    belief = [1 / u.tolerance**2 if np.isfinite(u.tolerance) else 0.0 for u in unknowns]
    expected = shared.T @ shared + np.diag(belief)
    # Sums over 1000 samples in another order.
    size = np.sqrt(np.outer(np.diag(expected), np.diag(expected)))
    assert np.abs((point.shared_hessian - expected) / size).max() < 1e-11
    assert problem.consistency is None


def test_a_direction_that_rounding_has_lost_is_no_failure():
    # An unstable motion: both unknowns move the end of the record, only their sum is seen, and
    # what is believed of each (1e4) lies below the last digit of 1e30.
    steep = np.full((2, 2), 1e30)
    h, gradient, factors = reduced(
        _point(steep + 1e4 * np.eye(2), np.ones((2, 1)), np.array([2e10, 2e10])), 0.0
    )
    assert np.isfinite(h).all()
    assert np.isfinite(gradient).all()
    # The sum of the unknowns goes where the data say, by equal shares.
    assert factors[0][:, -1] == pytest.approx([1e-20, 1e-20], rel=1e-6)


def _short_pieces(machine, sample_time):
    springs = tuple(Spring('inner', 1.0, (x, 1.0), 200.0, 0.5) for x in (1.3, -1.3))
    whole = rehearse('swing', machine, Setup(springs=springs), [0.1, -0.1, 0.3, -0.5],
                     [lambda t: 6 * np.sin(5 * t)], 12.0, sample_time)  # fmt: skip
    return whole.segments(0.6)


def test_a_wrong_simulation_starts_where_it_errs_least(model_file):
    nominal = Model.load(model_file)
    machine = nominal.with_effect('cogging_torque', amplitude=20.0, cycles=9.0, phase=0.3)
    data_sets = prepare(nominal, _short_pieces(machine, 0.004))
    best, found = (fit(nominal, data_sets, only=[], reweight=weighs) for weighs in (False, True))
    assert best.normalised_error > 1000
    # The guesses of the initial motions are believed no more than the samples behind them. The
    # weighted cost is 180: the last steps would gain a tenth each, SMALL_GAIN, of that.
    assert found.normalised_error == pytest.approx(best.normalised_error, rel=3e-3)


def test_model_error_counts_by_its_time_and_not_by_its_samples(model_file):
    nominal = Model.load(model_file)
    machine = nominal.with_effect('cogging_torque', amplitude=20.0, cycles=9.0, phase=0.3)
    dense, sparse = (fit(nominal, prepare(nominal, _short_pieces(machine, sample_time)))
                     for sample_time in (0.002, 0.008))  # fmt: skip
    # Model error is a smooth curve: four times as many samples of it say nothing new.
    assert dense.count.sum() > 3.9 * sparse.count.sum()
    assert dense.inflation / sparse.inflation == pytest.approx(
        4 * dense.normalised_error / sparse.normalised_error, rel=0.05
    )


def test_only_a_round_whose_weights_nobody_knows_stops_early(model_file, monkeypatch):
    model = Model.load(model_file)
    data_sets = prepare(model, _short_pieces(model, 0.004))
    minimise, drifts, horizons = identify.minimise, [], []

    def told(problem, theta, motions, horizon, weight, iterations, drift, reach, **how):
        drifts.append(drift)
        horizons.append(horizon)
        return minimise(problem, theta, motions, horizon, weight, iterations, drift, reach, **how)

    monkeypatch.setattr(identify, 'minimise', told)
    first = fit(model, data_sets, only=[])
    # 0.5 s of pieces of 0.6 s are more than four fifths of their samples.
    assert set(horizons) == {first.horizon}
    assert (drifts[0], drifts[-1]) == (identify.LEADING, identify.DRIFT)
    # One round alone, or weights that need not be known: at once to the minimum.
    for how in ({'iterations': 8}, {'reweight': False}):
        drifts.clear()
        fit(model, data_sets, only=[], **how)
        assert set(drifts) == {identify.DRIFT}


def test_what_has_no_curvature_left_stays_and_the_others_step():
    """The start of a record makes up for the first unknown, but for what is lost in rounding."""
    lost = 1e-14
    shared, coupling = np.array([[9.0, 1.0], [1.0, 5.0]]), np.array([[3.0, 2.0]])
    nothing = np.zeros((1, 1))
    for left in (lost, 0.0, -lost):
        point = Point(
            cost=1.0, shared_hessian=shared + np.diag([9.0 * left, 0.0]),
            shared_gradient=np.array([1e-3, 7.0]),
            own=[(np.eye(1), coupling, np.array([2.0]))], sse=nothing, count=nothing,
            data_cost=1.0, border=Border(0.0, np.zeros(2), np.zeros((2, 2))),
        )  # fmt: skip
        step, _ = descent._step(point, 0.0, np.array([False, False]))
        # Schur complements: 5 - 2 * 2 and 7 - 2 * 2.
        np.testing.assert_allclose(step, [0.0, -3.0])


def test_a_curvature_that_rounding_turned_is_solved_at_once():
    # Of a record of a robot whose sensitivities ran away; LAPACK went on for minutes with it.
    column = np.array([1e9, 1e16, 3e13, 1e13, 5e15])
    a = np.outer(column, column)
    a[0, 0] = -9e22
    x = solve(a, np.column_stack([column, np.ones(5)]))
    assert np.isfinite(x).all()


def test_the_sandwich_widens_only_what_the_curvature_tells():
    """Of the second number the curvature tells nothing; the third it tells too surely."""
    inverse, sandwich = np.diag([4.0, 0.0, 1e-12]), np.diag([1.0, 1e280, 9e-12])
    with np.errstate(all='raise'):
        assert _widening(sandwich, inverse) == pytest.approx([1.0, 1.0, 3.0])


@pytest.fixture
def short_records():
    """Eight short records of a hanging arm, and the point that its model file believes."""
    believed = nominal()
    data_sets = prepare(believed, [recorded(believed, 1.0, k) for k in range(8)])
    unknowns = unknowns_of(believed)
    problem = Problem(believed, data_sets, unknowns, _guesses(believed, data_sets, {}), 1.0)
    return problem, np.array([u.to_coordinate(u.prior) for u in unknowns])


def _led_astray(problem, theta, numbers):
    motions = [m + (0.3 if i in numbers else 0.0) for i, m in enumerate(problem.guesses)]
    before = attempt(problem, theta, list(problem.guesses), np.inf)
    return before, attempt(problem, theta, motions, np.inf)


def test_a_window_that_a_step_led_astray_settles_by_itself(short_records):
    problem, theta = short_records
    before, trial = _led_astray(problem, theta, {5})
    assert trial.cost(1.0) > 100 * before.cost(1.0)
    found = settled(trial, before, 1.0)
    for block in problem.blocks:
        was, now = (t.cost_of(block.data_sets, 1.0) for t in (before, found))
        assert now < SPOILT * was + 1
    moved = [a is not b for a, b in zip(found.motions, trial.motions, strict=True)]
    assert np.flatnonzero(moved).tolist() == [5]
    # Its normal equations are those of where it is now.
    again = attempt(problem, theta, found.motions, np.inf)
    assert found.cost(1.0) == pytest.approx(again.cost(1.0), rel=1e-12)
    assert np.allclose(found.point(1.0).shared_hessian, again.point(1.0).shared_hessian)


def test_where_many_windows_went_astray_the_step_was_too_long(short_records):
    problem, theta = short_records
    before, trial = _led_astray(problem, theta, {1, 4, 6})
    assert settled(trial, before, 1.0) is trial


def test_far_from_the_noise_a_fit_loses_little_by_seeking_no_floor_of_a_valley(
    model_file, monkeypatch
):
    believed = Model.load(model_file)
    hidden = {'stiffness': 40.0, 'rotor_inertia': 0.15, 'damping': 0.1}
    machine = believed.with_effect('joint_flexibility', **hidden)
    spring = Spring('inner', 1.0, (1.3, 1.0), 200.0, 0.5)
    records = [
        rehearse(
            f'record_{k}', machine, Setup(springs=(spring,)), [0.1, -0.1, 0.3, -0.5],
            [lambda t, f=0.5 + 0.2 * k: 9.0 * np.sin(2 * np.pi * (f + 0.15 * t) * t)],
            6.0, 0.004, k,
        )
        for k in range(2)
    ]  # fmt: skip
    data_sets = prepare(believed, records)
    found = fit(believed, data_sets)
    assert found.normalised_error > descent.CLOSE
    monkeypatch.setattr(identify, 'CLOSE', np.inf)
    to_the_floor = fit(believed, data_sets)
    # A thousandth of the cost in each of the last steps: a few per cent in all.
    assert found.normalised_error < 1.05 * to_the_floor.normalised_error


class _Creeping:
    """A trial that is its own point: a promise of 50, of which each step keeps next to nothing."""

    theta, motions, count = np.zeros(0), (), np.ones(1)

    def __init__(self, cost):
        self.cost = cost
        self.sse = np.array([cost])

    def point(self, weight):
        return self

    def beside(self, before, barrier):
        return self


@pytest.mark.parametrize(('shortest', 'steps', 'ends'), [(1e-3, 3, True), (0.0, 3, None)])
def test_where_only_short_steps_gain_and_little_is_a_minimum(monkeypatch, shortest, steps, ends):
    """Where longer ones gain as well it goes on: that short ones gain little says nothing."""
    monkeypatch.setattr(descent, '_promised', lambda *_: 50.0)
    monkeypatch.setattr(descent, 'settled', lambda trial, *_: trial)
    monkeypatch.setattr(descent._Way, '_frozen', lambda *_: np.zeros(0, bool))
    problem = SimpleNamespace(unknowns=())
    way = descent._Way(problem, 1.0, 1.0, False, descent.NEAR, np.zeros(0, bool), _Creeping(1e3),
                       np.zeros(0), [], 1e-3)  # fmt: skip
    way._barrier = 0.0
    gain = 0.5 * descent.SMALL_GAIN

    def ahead(theta, motions, point, damping):
        return _Creeping(point.cost + (1.0 if damping < shortest / 2 else -gain))

    monkeypatch.setattr(way, '_ahead', ahead)
    monkeypatch.setattr(way, '_back', lambda trial: trial)
    monkeypatch.setattr(way, '_cost', lambda trial: trial.cost)
    monkeypatch.setattr(way, '_normal', lambda trial: trial)
    assert [way.step(0.0) for _ in range(steps)] == [None] * (steps - 1) + [ends]
