"""Orbits against another integration of the hybrid model, balances of energy and momentum, gaits.

The robot of these tests has legs that differ more than the real one's.
"""

from dataclasses import replace

import numpy as np
import pytest
from scipy.integrate import solve_ivp

from cg_control.orbits.closing import closed, half_angle
from cg_control.orbits.floquet import monodromy, multipliers, section_map
from cg_control.orbits.orbit import Orbit, Sampled, plan_orbit
from cg_control.orbits.orbit_library import orbit_library
from cg_control.trajectories.collocation import PlanningError, planning_model
from cg_control.trajectories.trajectory import Phase, Trajectory
from cg_control.trajectories.tvlqr import stabilise
from cg_dynamics.assemble import parameter_vector
from cg_dynamics.rig import Setup
from cg_dynamics.rollout.compiled import compile_model
from cg_dynamics.walking.gait import find_gait, section_coordinates, section_state
from cg_dynamics.walking.hybrid import WalkOptions, walk
from cg_dynamics.walking.impact import impact

LENGTH, SPEED, SLOPE = 0.32, 0.35, -0.01
EXACT = {'method': 'DOP853', 'rtol': 1e-13, 'atol': 1e-14}


@pytest.fixture(scope='module')
def walker(robot):
    return robot.with_values({'c1': 0.092, 'c2': 0.152, 'c4': 0.104, 'c5': 0.133})


@pytest.fixture(scope='module')
def orbit(walker):
    return plan_orbit(walker, SPEED, LENGTH, SLOPE)


class Rates:
    """dx/dt of many states at once: (m, 4) and torques (m,) to (m, 4)."""

    def __init__(self, model, stance):
        self.f = compile_model(model, Setup(stance=stance)).f
        self.p = parameter_vector(model, Setup(stance=stance))

    def __call__(self, x, u):
        return np.asarray(self.f(x.T, u[None, :], self.p)).T


def height(x, stance, slope, l):
    st, sw = (x[0], x[1]) if stance == 'inner' else (x[1], x[0])
    return l * (np.cos(st) - np.cos(sw)) + l * (np.sin(st) - np.sin(sw)) * np.tan(slope)


def hybrid_map(orbit, sections, feedback):
    """Where sections (m, 3) get to in a period of the exact model, by Dormand and Prince.

    The torque, the gains and the state that they refer to are functions of the time since the
    last impact, and go on smoothly where an impact is late. The reference is integrated beside.
    """
    stance, l = orbit.trajectory.modes[0], orbit.model.values['leg_length']
    x = np.array([section_state(s, stance, orbit.slope) for s in sections])
    for phase in orbit.trajectory.phases:
        rates, last = Rates(orbit.planned, phase.stance), len(phase.time) - 2
        y = np.vstack([phase.states[:1], x])

        def flow(t, y, k, phase=phase, rates=rates):
            y = y.reshape(-1, 4)
            s = (t - phase.time[k]) / (phase.time[k + 1] - phase.time[k])
            u0 = (1 - s) * phase.torque[k] + s * phase.torque[k + 1]
            u = np.full(len(y), u0)
            if feedback:
                u -= (y - y[0]) @ ((1 - s) * phase.gains[k] + s * phase.gains[k + 1])
            return rates(y, u).ravel()

        for k in range(last):
            span = phase.time[k], phase.time[k + 1]
            y = solve_ivp(flow, span, y.ravel(), args=(k,), **EXACT).y[:, -1].reshape(-1, 4)
        landed = []
        for one in y[1:]:

            def lands(t, y, k, phase=phase):
                return height(y[4:], phase.stance, orbit.slope, l)

            lands.terminal, lands.direction = True, -1
            span = phase.time[last], phase.end + 0.5 * (phase.end - phase.time[last])
            start = np.concatenate([y[0], one])
            done = solve_ivp(flow, span, start, args=(last,), events=lands, **EXACT)
            before = done.y_events[0][0][4:]
            landed.append(impact(orbit.planned, phase.stance, before).x_plus)
        x = np.array(landed)
    return np.array([section_coordinates(state, stance) for state in x])


@pytest.mark.parametrize(('feedback', 'step'), [(False, 3e-5), (True, 2e-4)])
def test_section_map_is_the_derivative_of_the_exact_hybrid_map(orbit, walker, feedback, step):
    orbit = Orbit(stabilise(orbit.trajectory, walker), walker)
    s = section_coordinates(orbit.trajectory.states[0], 'inner')
    nudges = [share * step * unit for unit in np.eye(3) for share in (-2, -1, 1, 2)]
    image = hybrid_map(orbit, np.array([s, *(s + nudge for nudge in nudges)]), feedback)
    # The motion closes in another integration, beyond an impact that it locates itself.
    np.testing.assert_allclose(image[0], s, atol=1e-10)
    # Central differences of fourth order; without feedback the map is much more bent.
    ends = image[1:].reshape(3, 4, 3)
    slopes = (ends[:, 0] - 8 * ends[:, 1] + 8 * ends[:, 2] - ends[:, 3]) / (12 * step)
    found = section_map(orbit, feedback)
    np.testing.assert_allclose(found, slopes.T, rtol=0, atol=1e-8)
    expected = np.linalg.eigvals(slopes.T)
    expected = expected[np.argsort(-np.abs(expected))]
    np.testing.assert_allclose(multipliers(orbit, feedback), expected, rtol=0, atol=1e-8)


def test_orbit_is_what_was_demanded(orbit, walker):
    motion = orbit.trajectory
    assert motion.modes == ('inner', 'outer')
    assert motion.model_hash == walker.hash
    assert {**motion.provenance}.items() >= {
        'periodic': True, 'slope': SLOPE, 'friction': 'to be compensated'
    }.items()  # fmt: skip
    np.testing.assert_allclose(orbit.step_lengths, LENGTH, rtol=0, atol=1e-10)
    assert orbit.speed == pytest.approx(SPEED, abs=1e-10)
    assert orbit.period == pytest.approx(2 * LENGTH / SPEED, abs=1e-10)
    # The legs differ, so the steps do.
    first, second = (phase.end - phase.start for phase in motion.phases)
    assert abs(first - second) > 0.02
    assert orbit.problem == ''


def test_knots_are_on_one_exact_motion(orbit):
    for phase in orbit.trajectory.phases:
        rates = Rates(orbit.planned, phase.stance)
        np.testing.assert_allclose(rates(phase.states, phase.torque), phase.rates, atol=1e-12)

        def flow(t, x, phase=phase, rates=rates):
            return rates(x[None], np.array([np.interp(t, phase.time, phase.torque)]))[0]

        for k in range(0, len(phase.time) - 1, 4):
            span = phase.time[k], phase.time[k + 1]
            end = solve_ivp(flow, span, phase.states[k], **EXACT).y[:, -1]
            np.testing.assert_allclose(end, phase.states[k + 1], rtol=0, atol=1e-10)


def test_the_walker_lands_when_the_orbit_does_and_not_before(orbit):
    hold = 5e-4
    for phase in orbit.trajectory.phases:

        def command(t, stance, x, phase=phase):
            return np.array([np.interp(phase.start + t + hold / 2, phase.time, phase.torque)])

        duration = phase.end - phase.start
        done = walk(
            orbit.planned, phase.stance, phase.states[0], duration + 0.05, command,
            WalkOptions(slope=SLOPE, step=hold, sample_time=hold, largest_steps=1),
        )  # fmt: skip
        assert [event.kind for event in done.events] == ['impact']
        # The torque is held for a while, and the landing is flat.
        assert done.time == pytest.approx(duration, abs=1e-5)


def test_work_of_the_torque_is_what_impacts_and_the_climb_take(orbit, walker):
    """Motor and friction: none of these numbers is computed from the torque."""
    weight = walker.values['total_mass'] * walker.values['gravity']
    taken = sum(struck.energy_lost for struck in orbit.impacts)
    taken -= weight * np.sin(SLOPE) * sum(orbit.step_lengths)
    slip = [s.states[:, 2] - s.states[:, 3] for s in orbit.samples]
    work = sum(
        np.trapezoid(s.torque * rate, s.time) for s, rate in zip(orbit.samples, slip, strict=True)
    )
    # What is measured is cubic between the knots.
    assert work == pytest.approx(taken, rel=2e-4)
    rubbed = sum(
        np.trapezoid(1.84 * np.abs(rate) + 0.694 * rate**2, s.time)
        for s, rate in zip(orbit.samples, slip, strict=True)
    )
    way = weight * sum(orbit.step_lengths)
    braked = (orbit.cost_of_transport - orbit.positive_cost_of_transport) * way
    assert braked >= 0
    net = (orbit.positive_cost_of_transport * way) - braked
    # Dry friction is a little less than 1.84 N m where the hip turns.
    assert net == pytest.approx(work + rubbed, rel=2e-3)


def test_ground_forces_and_impulses_carry_the_weight(orbit, walker):
    """Momentum is the same after a period, so gravity is all that the ground balances."""
    weight = walker.values['total_mass'] * walker.values['gravity']
    axes = np.array([[np.cos(SLOPE), -np.sin(SLOPE)], [np.sin(SLOPE), np.cos(SLOPE)]])
    total = sum(struck.impulse for struck in orbit.impacts)
    for sampled, force in zip(orbit.samples, orbit.ground_forces, strict=True):
        total = total + np.trapezoid(force @ axes, sampled.time, axis=0)
    np.testing.assert_allclose(total, [0.0, weight * orbit.period], atol=2e-4 * weight)
    assert 0.5 * weight < orbit.least_load < weight
    assert 0 < orbit.friction_needed < 1


def test_passive_gait_has_a_multiplier_of_one_and_those_of_its_return_map(robot):
    """Without torque a motion is autonomous: what is off along it stays so."""
    slope = 0.0525
    walker = planning_model(robot, False).with_values({
        'leg_length': 1.0, 'total_mass': 20.0, 'c1': 0.0625, 'c2': 0.0631, 'c3': 1e-7,
        'c4': 0.125, 'c5': 0.124, 'c6': 0.0,
    })  # fmt: skip
    options = WalkOptions(slope=slope, step=0.002, sample_time=10.0)
    gait = find_gait(walker, 'inner', [0.26, 1.21, 0.71], options, steps=2)
    phases = []
    for arc in gait.walk.arcs[:2]:
        rates = Rates(walker, arc.stance)(arc.states, np.zeros(len(arc.time)))
        rows = np.append(np.arange(0, len(arc.time) - 2, 10), len(arc.time) - 1)
        phases.append(
            Phase(arc.stance, arc.time[rows], arc.states[rows], rates[rows], np.zeros(len(rows)))
        )
    passive = Orbit(Trajectory(tuple(phases), walker.hash, {'slope': slope}), walker)
    values = np.linalg.eigvals(monodromy(passive, restarts=False))
    nearest = np.abs(values - 1).argmin()
    # The gait repeats itself to 1e-10, integrated at 2 ms.
    assert values[nearest] == pytest.approx(1.0, abs=1e-8)
    others = np.sort_complex(np.delete(values, nearest))
    np.testing.assert_allclose(np.sort_complex(multipliers(passive)), others, atol=1e-7)
    # Differences of walks over 1e-5, whose impacts are located to 1e-12 s and bend the map.
    np.testing.assert_allclose(
        np.sort_complex(gait.multipliers), np.sort_complex(multipliers(passive)), atol=1e-4
    )


@pytest.mark.evidence
def test_library_reaches_as_far_as_the_torque_does(walker):
    library = orbit_library(
        walker, 0.3, torque_limit=8.0, begin=(0.3,), spacing=0.1, resolution=0.05,
        bounds=(0.2, 1.0),
    )  # fmt: skip
    assert library.speeds[0] == pytest.approx(0.2, abs=1e-9)
    assert 0.3 <= library.speeds[-1] < 0.6
    assert (np.diff(library.speeds) > 0.04).all()
    assert 'search ends' in library.slower
    assert 'motion' in library.faster
    for orbit in library.orbits:
        np.testing.assert_allclose(orbit.step_lengths, 0.3, atol=1e-10)
        # Where the hip turns, friction within the limit is counted softer than it is.
        assert orbit.peak_torque < 8.0 + 1.84
    assert library.nearest(0.21) is library.orbits[0]


def test_what_no_robot_can_walk_has_a_problem(orbit, walker):
    quick = tuple(
        replace(phase, states=phase.states * [1, 1, 15, 15]) for phase in orbit.trajectory.phases
    )
    assert 'have to pull' in Orbit(orbit.trajectory.with_phases(quick), walker).problem
    back = tuple(
        replace(phase, states=np.vstack([phase.states[:-1], phase.states[-1] * [1, 1, -1, -1]]))
        for phase in orbit.trajectory.phases
    )
    assert 'pulls at the foot' in Orbit(orbit.trajectory.with_phases(back), walker).problem


@pytest.mark.parametrize(('dip', 'early'), [(-0.05, True), (0.05, False)])
def test_a_foot_that_lands_early_is_seen(walker, dip, early):
    """The swing foot ahead: above the ground, in it or not, above it, and down at the end."""
    swing = -np.array([0.2 - 0.1, 0.2 + 0.02, 0.2 + dip, 0.2 + 0.02, 0.2])
    states = np.column_stack([np.full(5, 0.2), swing, np.zeros((5, 2))])
    states[0, 0] = 0.0
    phase = Phase('inner', np.arange(5.0), states, np.zeros((5, 4)), np.zeros(5))
    assert Sampled.of(phase, walker, 0.0).lands_early == early


def test_a_second_search_keeps_the_foot_above_the_ground(walker, monkeypatch):
    """Where the first finds nothing; and it is not asked where the foot is kept there anyway."""
    depths = []

    def found_nothing(model, task, *_):
        depths.append(task.retraction)
        raise PlanningError(f'nothing within {task.retraction} m', 7)

    monkeypatch.setattr('cg_control.orbits.orbit._orbit', found_nothing)
    with pytest.raises(PlanningError, match='nothing within inf') as caught:
        plan_orbit(walker, 0.3, 0.3)
    assert depths == [np.inf, 0.02]
    assert caught.value.iterations == 14
    with pytest.raises(PlanningError, match=r'nothing within 0\.01'):
        plan_orbit(walker, 0.3, 0.3, retraction=0.01)
    assert depths == [np.inf, 0.02, 0.01]


def test_nonsense_is_refused(orbit, walker):
    with pytest.raises(ValueError, match='speed is 0'):
        plan_orbit(walker, 0.0, 0.3)
    with pytest.raises(ValueError, match='twice the leg length'):
        plan_orbit(walker, 0.3, 2.2)
    with pytest.raises(PlanningError, match='does not close'):
        closed(orbit.trajectory, orbit.planned, half_angle(walker, 1.5), 0.2, SLOPE)
