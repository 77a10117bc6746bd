"""Hybrid simulation: located impacts, a passive walker, and its energy balance."""

import numpy as np
import pytest

from cg_dynamics.errors import SimulationError
from cg_dynamics.rig import STANCES
from cg_dynamics.walking.gait import GaitError, find_gait, section_coordinates, section_state
from cg_dynamics.walking.hybrid import Walker, WalkOptions, swing_foot, walk

# The classic passive walker: two point-mass legs of 5 kg at half of 1 m, 10 kg at the hip.
m, mh, a, b = 5.0, 10.0, 0.5, 0.5
CLASSIC = {
    'leg_length': a + b, 'total_mass': 2 * m + mh, 'gravity': 9.81,
    'c1': m * b**2 / 20 + 1e-7, 'c2': m * b**2 / 20 + 1e-7, 'c3': 1e-7,
    'c4': m * b / 20, 'c5': m * b / 20, 'c6': 0.0,
}  # fmt: skip
SLOPE = 0.0525
GUESS = np.array([0.27, 1.09, 0.38])


@pytest.fixture
def walker(bare):
    return bare.with_values(CLASSIC)


@pytest.fixture(scope='module')
def gait_of():
    """Gaits by model hash: finding one takes a second."""
    found = {}

    def find(model, **options):
        key = (model.hash, tuple(options.items()))
        if key not in found:
            found[key] = find_gait(model, 'inner', GUESS, WalkOptions(slope=SLOPE), **options)
        return found[key]

    return find


def test_classic_walker_has_a_stable_gait(walker, gait_of):
    gait = gait_of(walker, steps=1)
    assert gait.stable
    assert gait.residual < 1e-10
    # Both feet on the ground: the half angle between the legs fixes the step.
    alpha = section_coordinates(gait.x0, 'inner')[0]
    np.testing.assert_allclose(gait.step_lengths[0], 2 * np.sin(alpha), rtol=1e-9)


def test_gait_repeats_itself_for_many_steps(walker, gait_of):
    gait = gait_of(walker, steps=1)
    done = walk(walker, 'inner', gait.x0, 8.0, None, WalkOptions(slope=SLOPE))
    assert done.outcome == 'time'
    assert len(done.impacts) >= 10
    for event in done.impacts:
        now = section_coordinates(event.impact.x_plus, event.impact.stance)
        np.testing.assert_allclose(now, section_coordinates(gait.x0, 'inner'), atol=1e-9)
    assert [event.stance for event in done.impacts[:4]] == ['inner', 'outer', 'inner', 'outer']


def test_disturbed_gait_returns(walker, gait_of):
    gait = gait_of(walker, steps=1)
    start = section_coordinates(gait.x0, 'inner') + np.array([0.004, -0.01, 0.01])
    x0 = section_state(start, 'inner', SLOPE)
    done = walk(walker, 'inner', x0, 12.0, None, WalkOptions(slope=SLOPE))
    last = done.impacts[-1].impact
    np.testing.assert_allclose(
        section_coordinates(last.x_plus, last.stance),
        section_coordinates(gait.x0, 'inner'), atol=1e-4,
    )  # fmt: skip


def test_each_step_loses_in_the_impact_what_the_slope_gave(walker, gait_of):
    gait = gait_of(walker, steps=1)
    descent = gait.step_lengths[0] * np.sin(SLOPE)
    lost = gait.walk.impacts[0].impact.energy_lost
    # Newton's residual and the step of 1 ms.
    np.testing.assert_allclose(lost, CLASSIC['total_mass'] * 9.81 * descent, rtol=1e-9)


def test_stance_foot_leaves_the_ground_at_the_impact(walker, gait_of):
    event = gait_of(walker, steps=1).walk.impacts[0]
    normal = np.array([np.sin(SLOPE), np.cos(SLOPE)])
    assert event.impact.foot_velocity @ normal > 0
    assert event.impact.impulse @ normal > 0


def test_gait_in_the_frame_of_the_ground_is_the_same(walker, gait_of):
    """Angles from the ground, and the effect ground_slope in place of the option."""
    sloped = walker.with_effect('ground_slope', angle=SLOPE)
    gait = find_gait(sloped, 'inner', GUESS, WalkOptions(), steps=1)
    reference = gait_of(walker, steps=1)
    np.testing.assert_allclose(gait.x0 + np.array([SLOPE, SLOPE, 0, 0]), reference.x0, atol=1e-9)
    np.testing.assert_allclose(gait.period, reference.period, rtol=1e-9)
    np.testing.assert_allclose(gait.step_lengths, reference.step_lengths, rtol=1e-9)


def test_unequal_legs_have_a_gait_of_two_steps(walker):
    limping = walker.with_values({'c1': 0.0640, 'c4': 0.126})
    gait = find_gait(limping, 'inner', GUESS, WalkOptions(slope=SLOPE), steps=2)
    assert gait.step_lengths[0] != pytest.approx(gait.step_lengths[1], rel=1e-4)
    descent = sum(gait.step_lengths) * np.sin(SLOPE)
    lost = sum(event.impact.energy_lost for event in gait.walk.impacts)
    np.testing.assert_allclose(lost, CLASSIC['total_mass'] * 9.81 * descent, rtol=1e-9)


def test_no_gait_far_from_any(walker):
    with pytest.raises(GaitError, match='no gait'):
        find_gait(walker, 'inner', np.array([0.05, 0.1, 0.0]), WalkOptions(slope=0.0), steps=1)


def test_impact_is_located_and_converges_with_the_order_of_the_integrator(walker):
    """At the event the foot is on the ground to rounding; halving steps gains a factor of 16."""
    x0 = section_state(GUESS, 'inner', SLOPE)
    instants = {}
    for step in (8e-3, 4e-3, 2.5e-4):
        options = WalkOptions(slope=SLOPE, step=step, sample_time=1.0, largest_steps=1)
        # The compiled model would cap the step; take it away for the sake of the order.
        done = _walk_with_step(walker, x0, options, step)
        event = done.impacts[0]
        x, z = swing_foot(event.x, 'inner', 1.0)
        assert abs(z + x * np.tan(SLOPE)) < 1e-11
        instants[step] = event.time
    errors = [abs(instants[step] - instants[2.5e-4]) for step in (8e-3, 4e-3)]
    assert errors[0] / errors[1] > 8
    assert errors[1] < 1e-8


def _walk_with_step(model, x0, options, step):
    walker = Walker(model, options, None)
    walker.step = step
    return walker.run('inner', x0, 2.0)


@pytest.mark.parametrize('stance', STANCES)
def test_guard_is_positive_above_and_negative_below_the_ground(walker, stance):
    standing = {'inner': [0.1, -0.2], 'outer': [-0.2, 0.1]}[stance]
    x, z = swing_foot(standing, stance, 1.0)
    # The swing leg leans more, so its foot is higher; it points ahead.
    assert x == pytest.approx(np.sin(0.1) + np.sin(0.2))
    assert z == pytest.approx(np.cos(0.1) - np.cos(0.2))
    assert z > 0
    x, z = swing_foot([0.3, -0.2] if stance == 'inner' else [-0.2, 0.3], stance, 1.0)
    assert x > 0 > z


def test_scuffing_is_seen_and_is_not_an_impact(walker, gait_of):
    x0 = gait_of(walker, steps=1).x0
    plain = walk(walker, 'inner', x0, 0.8, None, WalkOptions(slope=SLOPE))
    assert [event.kind for event in plain.events] == ['impact']
    seen = walk(walker, 'inner', x0, 0.8, None, WalkOptions(slope=SLOPE, clearance=0.001))
    assert [event.kind for event in seen.events][:2] == ['scuff', 'impact']
    scuff = seen.events[0]
    x, z = swing_foot(scuff.x, 'inner', 1.0)
    assert z + x * np.tan(SLOPE) == pytest.approx(-0.001, abs=1e-10)
    retracted = WalkOptions(slope=SLOPE, clearance=0.1)
    assert [e.kind for e in walk(walker, 'inner', x0, 0.8, None, retracted).events] == ['impact']
    stopped = walk(
        walker, 'inner', x0, 0.8, None,
        WalkOptions(slope=SLOPE, clearance=0.001, stop_on_scuff=True),
    )  # fmt: skip
    assert stopped.outcome == 'scuff'
    assert stopped.time == pytest.approx(scuff.time, abs=1e-12)


def test_robot_that_leans_too_far_has_fallen(robot):
    done = walk(robot, 'inner', np.array([-0.2, 0.0, -1.0, 0.0]), 5.0)
    assert done.outcome == 'fall'
    assert abs(done.state[0]) == pytest.approx(1.0, abs=1e-9)


def test_a_leg_that_swings_too_far_ends_the_walk(robot):
    x0, kick = np.array([0.0, 0.0, 0.0, 8.0]), WalkOptions(swing_angle=1.2)
    done = walk(robot, 'inner', x0, 5.0, None, kick)
    assert done.outcome == 'fall'
    assert abs(done.state[1]) == pytest.approx(1.2, abs=1e-9)
    assert abs(done.state[0]) < 1.0


def test_a_robot_that_falls_is_moved_on(robot):
    """A walk ends at a fall; `move` goes on, whatever the robot does."""
    walker = Walker(robot, WalkOptions(fall_angle=0.5, swing_angle=0.5), None)
    leg, x = walker.stand('inner'), np.array([-0.2, 0.0, -1.0, 0.0])
    for _ in range(300):
        leg, x = walker.move(leg, x, walker.inputs(0.0), 0.002)
    assert x[0] < -0.8


def test_command_is_sampled_held_and_late(bare):
    asked = []

    def command(time, stance, x):
        asked.append(time)
        return [2.0 if time < 0.0099 else -1.0]

    late = bare.with_effect('actuator_delay', delay=0.0031)
    done = walk(late, 'inner', np.array([0.0, 0.1, 0.1, 0.0]), 0.02, command)
    np.testing.assert_allclose(asked, np.arange(10) * 0.002, atol=1e-12)
    arc = done.arcs[0]
    expected = np.where(arc.time < 0.0031 - 1e-9, 0.0, np.where(arc.time < 0.0131 - 1e-9, 2, -1))
    np.testing.assert_array_equal(arc.inputs[:, 0], expected)


def test_torque_keeps_its_meaning_through_an_impact(walker):
    """A spring between the legs stores no energy over the stance change: no jump of sign."""
    stiffness = 8.0

    def spring(time, stance, x):
        return [-stiffness * (x[0] - x[1])]

    options = WalkOptions(slope=SLOPE, sample_time=0.0005, step=0.0005)
    done = walk(walker, 'inner', section_state(GUESS, 'inner', SLOPE), 2.5, spring, options)
    assert len(done.impacts) >= 2
    for before, after in zip(done.arcs[:-1], done.arcs[1:], strict=True):
        np.testing.assert_allclose(before.inputs[-1], after.inputs[0])
        np.testing.assert_array_equal(before.states[-1][:2], after.states[0][:2])


def test_step_limit_and_continuity(walker, gait_of):
    x0 = gait_of(walker, steps=1).x0
    done = walk(walker, 'inner', x0, 10.0, None, WalkOptions(slope=SLOPE, largest_steps=3))
    assert done.outcome == 'steps'
    assert len(done.impacts) == 3
    assert len(done.arcs) == 4
    for arc in done.arcs:
        assert (np.diff(arc.time) > 0).all()
        assert np.abs(np.diff(arc.states, axis=0)).max(initial=0) < 0.05


def test_runaway_is_an_error(walker):
    def blow(time, stance, x):
        return [1e9]

    with pytest.raises(SimulationError, match='runs away'):
        walk(walker, 'inner', np.zeros(4), 1.0, blow, WalkOptions(fall_angle=1e9))


@pytest.mark.parametrize(
    ('options', 'message'),
    [({'step': 0}, 'step'), ({'clearance': -1}, 'clearance'), ({'slope': 2}, 'slope')],
)
def test_options_out_of_range_are_named(options, message):
    with pytest.raises(ValueError, match=message):
        WalkOptions(**options)
