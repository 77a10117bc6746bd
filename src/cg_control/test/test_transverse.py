"""Transverse coordinates, their linearisation and LQR against the exact hybrid model.

What is compared with is integrated by scipy over time or phase, and knows nothing of A_z, B_z.
"""

from dataclasses import replace

import numpy as np
import pytest
from exact_motion import TIGHT, densified, over_phase, rates
from scipy.integrate import solve_ivp

from cg_control.following.nodes import Nodes
from cg_control.following.tracking import WALKING
from cg_control.orbits import transverse
from cg_control.orbits.orbit import plan_orbit
from cg_control.orbits.surfaces import UNITS, between, design_of, phase_of, with_surfaces
from cg_control.orbits.transverse import (
    OVER_PHASE,
    TRANSVERSE,
    UnstableError,
    frame,
    monodromy,
    projection,
    stabilise_over_phase,
    stabilise_transversely,
    transverse_linearisation,
    with_own_surfaces,
)
from cg_control.trajectories.collocation import Options, optimise, planning_model
from cg_control.trajectories.task import Box, Task
from cg_control.trajectories.trajectory import TrajectoryError
from cg_control.trajectories.tvlqr import (
    GAUSS,
    Weights,
    exponentials,
    jump_matrix,
    magnus,
    stabilise,
    stabilise_periodically,
)
from cg_control.trees.preview import LANDING
from cg_control.trees.rollouts import follow
from cg_dynamics.walking.hybrid import WalkOptions, walk
from cg_dynamics.walking.impact import impact

SLOPE = np.radians(-1.0)


@pytest.fixture(scope='module')
def walker(robot):
    """The robot with other numbers and legs that differ more."""
    return robot.with_values({'c1': robot.values['c1'] * 1.1, 'c5': robot.values['c5'] * 0.95})


@pytest.fixture(scope='module')
def gait(walker):
    """Uphill."""
    return plan_orbit(walker, 0.25, 0.35, SLOPE).trajectory


@pytest.fixture(scope='module')
def surfaces(gait, walker):
    return with_surfaces(gait, walker)


@pytest.fixture(scope='module')
def orbit(surfaces, walker):
    return stabilise_transversely(surfaces, walker)


@pytest.fixture(scope='module')
def fine(gait, walker):
    """With four times the knots: what a cubic between knots errs is then below 1e-6."""
    exact = densified(gait, design_of(gait, walker), 4)
    return stabilise_transversely(with_surfaces(exact, walker), walker)


def test_frame_spans_the_surface():
    rng = np.random.default_rng(0)
    n, rate = rng.normal(size=(2, 20, 4))
    E, Pi = frame(n), projection(n, rate)
    np.testing.assert_allclose(np.einsum('ki,kia->ka', n, E), 0.0, atol=1e-12)
    np.testing.assert_allclose(Pi @ E, np.tile(np.eye(3), (20, 1, 1)), atol=1e-9)
    np.testing.assert_allclose(np.einsum('kai,ki->ka', Pi, rate), 0.0, atol=1e-9)
    assert (np.linalg.matrix_rank(E) == 3).all()


def transverse_rates(design, phase, k, share, z, v):
    """dz/ds at one point by the motion itself: x a moment later, and its phase by projection."""
    moment = 1e-5
    s = phase.time[k] + share * (phase.time[k + 1] - phase.time[k])
    point = phase.at(s)
    x = point.state + frame(point.normal) @ z
    slope = (phase.torque[k + 1] - phase.torque[k]) / (phase.time[k + 1] - phase.time[k])

    def f(t, y):
        # The torque follows the phase; over a moment that is the clock to first order.
        return rates(design, phase.stance, y[None], np.array([point.torque + v + slope * t]))[0]

    def coordinates(t):
        y = solve_ivp(f, (0.0, t), x, **TIGHT).y[:, -1]
        at = phase_of(phase, y, s + t)
        there = phase.at(at)
        E = frame(there.normal)
        return at, np.linalg.lstsq(E / UNITS[:, None], (y - there.state) / UNITS)[0]

    (late, z_late), (early, z_early) = coordinates(moment), coordinates(-moment)
    return (z_late - z_early) / (late - early)


def test_linearisation_is_the_derivative_of_the_motion(surfaces, walker):
    """(TLIN) against differences of (z, s) along the exact motion, with nothing linearised."""
    design = design_of(surfaces, walker)
    for phase in surfaces.phases:
        share = 0.4
        points = between(phase, share)
        A, B = transverse_linearisation(design, phase.stance, points)
        for k in (1, 9, 17, 23):
            step, push = 1e-3, 0.01

            def dz(z, v=0.0, phase=phase, k=k, share=share):
                return transverse_rates(design, phase, k, share, z, v)

            size = np.linalg.norm(frame(points.normals[k]) / UNITS[:, None], axis=0)
            by_z = np.column_stack([
                (dz(step * e) - dz(-step * e)) / (2 * step) * s
                for e, s in zip(np.diag(1 / size), size, strict=True)
            ])  # fmt: skip
            by_v = (dz(np.zeros(3), push) - dz(np.zeros(3), -push)) / (2 * push)
            # Second derivatives of a moment, and f is not x0' between knots but to 1e-4.
            np.testing.assert_allclose(by_z, A[k], atol=2e-3 * np.abs(A[k]).max())
            np.testing.assert_allclose(by_v, B[k][:, 0], atol=2e-3 * np.abs(B[k]).max())


def test_map_from_surface_to_surface_is_the_transition_matrix(fine, walker):
    """A free motion over time that ends where it crosses a plane, the torque by its phase."""
    design = design_of(fine, walker)
    phase = replace(fine.phases[1], gains=[])
    first, last = 12, 44
    at, to = phase.normals[first], phase.normals[last]
    h = np.diff(phase.time)[first:last]
    A = np.array([
        transverse_linearisation(design, phase.stance, between(phase, share))[0][first:last]
        for share in (0.5 - np.sqrt(3) / 6, 0.5 + np.sqrt(3) / 6)
    ])  # fmt: skip
    expected = np.linalg.multi_dot(exponentials(magnus(h, A))[::-1])

    def landed(z):
        x = phase.states[first] + frame(at) @ z
        near = [phase.time[first]]

        def f(t, y):
            near[0] = phase_of(phase, y, near[0])
            u = phase.at(near[0]).torque
            return rates(design, phase.stance, y[None], np.array([u]))[0]

        def crossed(t, y):
            return to @ (y - phase.states[last])

        crossed.terminal, crossed.direction = True, 1
        span = 1.5 * (phase.time[last] - phase.time[first])
        done = solve_ivp(f, (0.0, span), x, 'DOP853', rtol=1e-10, atol=1e-12, events=crossed)
        return projection(to, phase.rates[last]) @ (done.y_events[0][0] - phase.states[last])

    step = 2e-3 / np.linalg.norm(frame(at) / UNITS[:, None], axis=0)
    found = np.column_stack([
        (landed(s * e) - landed(-s * e)) / (2 * s) for s, e in zip(step, np.eye(3), strict=True)
    ])  # fmt: skip
    # Third derivatives, over steps of 2 thousandths of a unit.
    np.testing.assert_allclose(found, expected, atol=1e-4 * np.abs(expected).max())


def test_jump_needs_no_instant_of_the_impact(orbit, walker):
    """(TJMP): between impact surfaces D alone says what (SALT) says."""
    design = design_of(orbit, walker)
    before, after = orbit.phases
    E, Pi = frame(before.normals[-1]), projection(after.normals[0], after.rates[0])
    jump = Pi @ jump_matrix(design, before, after, SLOPE) @ E
    step = 1e-6

    def landed(z):
        x = before.states[-1] + E @ z
        return Pi @ (impact(design, before.stance, x).x_plus - after.states[0])

    found = np.column_stack([
        (landed(step * e) - landed(-step * e)) / (2 * step) for e in np.eye(3)
    ])  # fmt: skip
    np.testing.assert_allclose(found, jump, atol=1e-7 * np.abs(jump).max())


@pytest.mark.parametrize('feedback', [True, False])
def test_multipliers_are_those_of_the_exact_hybrid_motion(fine, walker, feedback):
    """Round the orbit from impact surface to impact surface, phase by projection."""
    motion = fine
    if not feedback:
        motion = fine.with_phases(tuple(replace(p, gains=[]) for p in fine.phases))
    design, start = design_of(fine, walker), motion.phases[0]
    E, Pi = frame(start.normals[0]), projection(start.normals[0], start.rates[0])
    step = 3e-5 / np.linalg.norm(E / UNITS[:, None], axis=0)
    x = start.states[0] + np.vstack([np.diag(step), -np.diag(step)]) @ E.T
    for phase in motion.phases:
        x = over_phase(design, phase, x)
        # Whoever reaches the end of the phase has both feet on the ground.
        assert np.abs(x[:, 0] + x[:, 1] - 2 * SLOPE).max() < 1e-9
        x = np.array([impact(design, phase.stance, state).x_plus for state in x])
    z = (x - start.states[0]) @ Pi.T
    found = ((z[:3] - z[3:]) / (2 * step[:, None])).T
    expected = monodromy(motion, walker)
    size = max(1.0, np.linalg.norm(expected, 2))
    np.testing.assert_allclose(
        np.sort_complex(np.linalg.eigvals(found)), np.sort_complex(np.linalg.eigvals(expected)),
        atol=2e-6 * size,
    )  # fmt: skip
    assert (np.abs(np.linalg.eigvals(expected)).max() < 0.5) == feedback


def test_gains_do_not_see_deviations_along_the_motion(orbit):
    for phase in orbit.phases:
        size = np.linalg.norm(phase.gains, axis=1) * np.linalg.norm(phase.rates, axis=1)
        assert np.abs((phase.gains * phase.rates).sum(axis=1) / size).max() < 1e-12
        for S, rate in zip(phase.cost_to_go, phase.rates, strict=True):
            values = np.linalg.eigvalsh(S * np.outer(UNITS, UNITS))
            assert abs(values[0]) < 1e-9 * values[-1] < values[1]
            assert np.abs(S @ rate).max() < 1e-9 * np.abs(S).max() * np.linalg.norm(rate)


def test_cost_to_go_repeats_itself_and_is_what_a_period_costs(fine, walker):
    """z'Pz at the start is what a period costs plus z'Pz at its end, in the linear closed loop."""
    design, Q, R = design_of(fine, walker), TRANSVERSE, TRANSVERSE.R[0, 0]
    start = fine.phases[0]
    E = frame(start.normals[0])
    before = E.T @ start.cost_to_go[0] @ E

    def closed_loop(phase, share, k):
        points = between(phase, share).cut(slice(k, k + 1))
        A, B = transverse_linearisation(design, phase.stance, points)
        K = ((1 - share) * phase.gains[k] + share * phase.gains[k + 1]) @ frame(points.normals[0])
        return A[0] - B[0] @ K[None], K, frame(points.normals[0])

    cost, through = np.zeros((3, 3)), np.eye(3)
    for phase, after in zip(fine.phases, fine.phases[::-1], strict=True):
        for k, h in enumerate(np.diff(phase.time)):
            # Simpson's rule, with the way to the middle and to the end by (MAG4).
            running, ways = [], [np.eye(3)]
            for half in (0.0, 0.5):
                H = np.array([[closed_loop(phase, half + g / 2, k)[0]] for g in GAUSS])
                ways.append(exponentials(magnus(np.array([h / 2]), H))[0] @ ways[-1])
            for share, way in zip((0.0, 0.5, 1.0), ways, strict=True):
                _, K, E = closed_loop(phase, share, k)
                X = way @ through
                W = E.T @ Q.Q(phase.stance) @ E + np.outer(K, K) * R
                running.append(X.T @ W @ X)
            cost += h / 6 * (running[0] + 4 * running[1] + running[2])
            through = ways[-1] @ through
        jump = jump_matrix(design, phase, after, SLOPE)
        onto = projection(after.normals[0], after.rates[0])
        through = onto @ jump @ frame(phase.normals[-1]) @ through
    after = cost + through.T @ before @ through
    # Gains linear between knots are not quite the best ones: the cost is a little higher.
    np.testing.assert_allclose(after, before, atol=5e-3 * np.abs(before).max())


def test_a_robot_that_is_late_or_early_gets_the_torque_of_its_phase(orbit):
    """On the orbit but at another phase than believed: the torque changes to second order only."""
    phase = orbit.phases[0]
    for k in (3, 12, 20):
        for late in (-0.002, 0.002):
            x = phase.at(phase.time[k] + late).state
            wrong = phase.gains[k] @ (x - phase.states[k])
            clock = np.abs(phase.gains[k]) @ np.abs(x - phase.states[k])
            assert abs(wrong) < 0.05 * clock


def test_perturbed_robots_come_back(orbit, walker):
    """Sampled states after an impact, commands held for 2 ms, the torque of the motor limited."""
    robot, rng = planning_model(walker, False), np.random.default_rng(0)
    phases = {phase.stance: phase for phase in orbit.phases}
    for _ in range(2):
        state = {'leg': '', 's': 0.0, 't': 0.0}

        def command(t, leg, x, state=state):
            phase = phases[leg]
            s = phase.start if leg != state['leg'] else state['s'] + t - state['t']
            s = phase_of(phase, x, s)
            state.update(leg=leg, s=s, t=t)
            point = phase.at(s)
            u = point.torque - point.gain @ (x - point.state)
            return np.clip([u], -walker.torque_limit, walker.torque_limit)

        start = orbit.phases[0]
        # On the impact surface: as a landing that went a little wrong.
        d = rng.uniform(-0.1, 0.1, size=4) * UNITS
        d[1] = -d[0]
        done = walk(robot, 'inner', start.states[0] + d, 20.0, command,
                    WalkOptions(slope=SLOPE, largest_steps=2))  # fmt: skip
        assert done.outcome == 'steps'
        end = done.impacts[-1].impact.x_plus
        assert np.abs((end - start.states[0]) / UNITS).max() < 0.3 * np.abs(d / UNITS).max()


def test_a_step_in_ends_on_the_orbit(orbit, walker):
    """Its final cost is that of the orbit where it gets there, before the same impact."""
    goal = orbit.phases[1]
    task = Task(('outer',), goal=Box.point(goal.states[-1]), durations=(0.2, 2.0), slope=SLOPE)
    motion = with_surfaces(optimise(walker, task, Options(fine=20), friction=False), walker)
    (phase,) = stabilise_transversely(motion, walker, final_cost=goal.cost_to_go[-1]).phases
    E = frame(phase.normals[-1])
    expected = E.T @ goal.cost_to_go[-1] @ E
    found = E.T @ phase.cost_to_go[-1] @ E
    np.testing.assert_allclose(found, expected, atol=1e-9 * np.abs(expected).max())
    with pytest.raises(ValueError, match='final_cost is missing'):
        stabilise_transversely(motion, walker)


def test_where_there_are_no_surfaces_it_is_tvlqr(orbit, walker):
    """Up to where planes begin the cost to go is the one over time, from that of the planes."""
    phase = orbit.phases[0]
    normals = np.array(phase.normals)
    normals[:9] = 0.0
    one = replace(orbit, phases=(replace(phase, normals=normals),),
                  provenance={**orbit.provenance, 'periodic': False})  # fmt: skip
    (found,) = stabilise_transversely(one, walker, final_cost=phase.cost_to_go[-1]).phases
    np.testing.assert_allclose(found.cost_to_go[9:], phase.cost_to_go[9:],
                               atol=1e-6 * np.abs(phase.cost_to_go).max())  # fmt: skip
    early = replace(
        phase,
        **{
            name: getattr(phase, name)[:10]
            for name in ('time', 'states', 'rates', 'torque', 'gains', 'cost_to_go', 'normals')
        },
    )
    plain = stabilise(
        replace(one, phases=(early,)), walker, TRANSVERSE, final_cost=found.cost_to_go[9]
    )
    # There friction that is not dry takes part, here nothing that is compensated.
    np.testing.assert_allclose(found.cost_to_go[:10], plain.phases[0].cost_to_go,
                               atol=0.02 * np.abs(found.cost_to_go[:10]).max())  # fmt: skip


def test_what_cannot_be_is_refused(gait, orbit, walker, monkeypatch):
    with pytest.raises(TrajectoryError, match='no surfaces'):
        stabilise_transversely(gait, walker)
    with pytest.raises(ValueError, match='has no end'):
        stabilise_transversely(orbit, walker, final_cost=np.eye(4))
    with pytest.raises(TrajectoryError, match='not periodic'):
        monodromy(replace(orbit, provenance={}), walker)
    with pytest.raises(TrajectoryError, match='half of it is missing'):
        stabilise_transversely(replace(orbit, phases=orbit.phases[:1]), walker)
    monkeypatch.setattr(transverse, 'SWEEPS', 1)
    with pytest.raises(UnstableError, match='does not settle'):
        stabilise_transversely(orbit, walker)


def test_gains_over_phase_hold_the_robot_on_surfaces_of_their_own_cost(gait, walker):
    """A surface is where, along the motion, the cost to go is least; along it nothing costs."""
    done = stabilise_over_phase(gait, walker)
    over_time = stabilise_periodically(gait, walker, OVER_PHASE, restarts=True)
    rng = np.random.default_rng(7)
    for phase, plain in zip(done.phases, over_time.phases, strict=True):
        np.testing.assert_allclose((phase.normals * phase.rates).sum(axis=1), 1.0, atol=1e-12)
        np.testing.assert_allclose(phase.normals[-1][2:], 0.0)
        for k in (0, 10, -3):
            S, t, n = plain.cost_to_go[k], phase.rates[k], phase.normals[k]
            d = rng.normal(size=4) * UNITS
            d -= t * (n @ d)  # in the surface
            least = d @ S @ d
            np.testing.assert_allclose(phase.cost_to_go[k] @ t, 0.0, atol=1e-9 * np.abs(S).max())
            assert d @ phase.cost_to_go[k] @ d == pytest.approx(least, rel=1e-9)
            for off in (-1e-3, 1e-3):
                assert (d - off * t) @ S @ (d - off * t) > least
    x = done.states[0] + 0.3 * UNITS * [1, -1, 1, 1]
    nodes = Nodes.orbit(done, walker)
    ends = follow(
        nodes, walker, np.zeros(1, int), x[None], 20 * done.duration / 2, settings=WALKING,
        options=replace(LANDING, slope=SLOPE),
    )  # fmt: skip
    cost = nodes.cost_to_go(int(ends.node[0]), float(ends.elapsed[0]), ends.state[0])
    assert ends.impacts[0] >= 15
    assert cost < 1e-3 * nodes.cost_to_go(0, 0.0, x)


def test_transverse_gains_on_its_own_surfaces_walk_up_a_slope_that_is_not_known(robot):
    """Half a degree up, from a fifth of the box of bench/walking_rivals.py: widest planes fall."""
    orbit, count = plan_orbit(robot, 0.25, 0.3), 24
    d = 0.2 * np.random.default_rng(1).uniform(-1, 1, (count, 3)) * [0.08, 0.5, 1.0]
    x = orbit.trajectory.states[0] + np.column_stack([-d[:, 0], d[:, 0], d[:, 1], d[:, 2]])
    uphill = replace(LANDING, slope=-np.radians(0.5))
    # Landed on that ground, the legs as far apart.
    x[:, :2] += uphill.slope - x[:, :2].sum(axis=1)[:, None] / 2
    walk_on = {}
    for name, motion in (
        ('own', with_own_surfaces(orbit.trajectory, robot)),
        ('widest', with_surfaces(orbit.trajectory, robot)),
    ):
        done = stabilise_transversely(motion, robot, Weights())
        assert np.abs(np.linalg.eigvals(monodromy(done, robot))).max() < 0.5
        for phase in done.phases:
            assert np.abs((phase.normals * phase.rates).sum(axis=1) - 1).max() < 1e-9
            for k in (0, -1):
                np.testing.assert_allclose(phase.normals[k][:2].std(), 0.0, atol=1e-9)
                np.testing.assert_allclose(phase.normals[k][2:], 0.0, atol=1e-9)
        nodes = Nodes.orbit(done, robot)
        ends = follow(
            nodes, robot, np.zeros(count, int), x, 20 * orbit.period, settings=WALKING,
            options=uphill,
        )  # fmt: skip
        walk_on[name] = int((ends.impacts >= 20).sum())
    assert walk_on['own'] >= 0.9 * count
    assert walk_on['widest'] < count / 2
