"""Landing, rebound and sliding: laws that the formulas were not derived from."""

import itertools
import math

import casadi as ca
import numpy as np
import pytest
from test_impact import PointBodies

from cg_dynamics.assemble import parameter_vector
from cg_dynamics.effects.effect import ContactLaw
from cg_dynamics.rig import STANCES, Setup
from cg_dynamics.walking.contact import REST_SPEED, Ground, contact_impulse, contact_law, land
from cg_dynamics.walking.gait import section_state
from cg_dynamics.walking.hybrid import WalkOptions, walk
from cg_dynamics.walking.impact import impact, other
from cg_dynamics.walking.unpinned import ground_reaction, unpinned

SLOPE = 0.05
LAWS = [ContactLaw(e, mu) for e, mu in itertools.product((0.0, 0.3), (0.2, 0.5, 50.0, math.inf))]
# States in which the swing foot, ahead, comes down: (alpha, lean rate of stance, of swing leg).
LANDINGS = [(0.2, 1.4, 0.2), (0.31, 1.5, -0.4), (0.15, 1.0, 0.9)]


def landing_state(landing, stance):
    """Both feet on the ground, the swing foot ahead."""
    alpha, standing, swinging = landing
    q, v = np.array([SLOPE + alpha, SLOPE - alpha]), np.array([standing, swinging])
    return np.concatenate([q, v] if stance == 'inner' else [q[::-1], v[::-1]])


def momenta(model, stance, x, foot, foot_rate):
    """Bodies of the robot, its hip's place and velocity, from separate bodies."""
    leg, l = STANCES.index(stance), model.values['leg_length']
    a, w = x[leg], x[2 + leg]
    hip = foot + l * np.array([np.sin(a), np.cos(a)])
    hip_rate = foot_rate + l * w * np.array([np.cos(a), -np.sin(a)])
    return PointBodies(model, x[:2], x[2:4], hip_rate), hip


def energy(model, stance, x, foot, foot_rate):
    e = unpinned(model, stance)
    f = ca.Function('E', [e.q, e.v, e.p], [e.kinetic + e.potential])
    p = parameter_vector(model, Setup())
    return float(f([*x[:2], *foot], [*x[2:4], *foot_rate], p))


def stepping(
    model, law, duration=0.75, step=0.001, command=None, stance='inner', start=(0.2, 1.1, 0.0)
):
    """A walk down the slope with a landing in it."""
    if law.restitution:
        model = model.with_effect('impact_restitution', coefficient=law.restitution)
    if math.isfinite(law.friction):
        model = model.with_effect('foot_slip', friction=law.friction)
    assert contact_law(model) == law
    x0 = section_state(np.array(start), stance, SLOPE)
    return model, walk(model, stance, x0, duration, command, WalkOptions(slope=SLOPE, step=step))


def pull(time, stance, x):
    """Torque that swings the leg ahead of the other."""
    sign, swing = (1.0, 0) if stance == 'outer' else (-1.0, 1)
    return [sign * (60 * (-0.2 - x[swing]) - 6 * x[2 + swing])]


# --- the impulse -------------------------------------------------------------------------------


@pytest.mark.parametrize('law', LAWS, ids=str)
@pytest.mark.parametrize('stance', STANCES)
@pytest.mark.parametrize('landing', LANDINGS)
def test_landing_keeps_the_laws_of_mechanics(bare, law, stance, landing):
    x, ground = landing_state(landing, stance), Ground(SLOPE)
    done = land(bare, stance, x, law, ground)
    l = bare.values['leg_length']
    before, _ = momenta(bare, stance, x, np.zeros(2), np.zeros(2))
    leg = STANCES.index(other(stance))
    after, _ = momenta(bare, other(stance), done.x_plus, np.zeros(2), done.landing_velocity)
    # Rounding of 20 kg m/s.
    np.testing.assert_allclose(
        done.impulse, after.linear_momentum() - before.linear_momentum(), atol=1e-11
    )
    landed = -l * np.array([np.sin(x[leg]), np.cos(x[leg])])
    np.testing.assert_allclose(
        after.angular_momentum(landed), before.angular_momentum(landed), atol=1e-11
    )
    lost = before.kinetic_energy() - after.kinetic_energy()
    np.testing.assert_allclose(done.energy_lost, lost, atol=1e-10)
    assert lost > 0
    along, off = done.impulse @ ground.tangent, done.impulse @ ground.normal
    assert off > 0
    assert abs(along) <= law.friction * off * (1 + 1e-12)
    # The foot came with the velocity of the hip and its own about it.
    came = l * x[3 - leg] * turning(x[1 - leg]) - l * x[2 + leg] * turning(x[leg])
    np.testing.assert_allclose(
        done.landing_velocity @ ground.normal, -law.restitution * (came @ ground.normal),
        atol=1e-12,
    )  # fmt: skip
    slip = done.landing_velocity @ ground.tangent
    if abs(slip) > 1e-9:
        np.testing.assert_allclose(along, -law.friction * np.sign(slip) * off, rtol=1e-12)


def turning(angle):
    return np.array([np.cos(angle), -np.sin(angle)])


def test_some_of_these_landings_stick_and_some_slide(bare):
    found = {
        land(bare, 'inner', landing_state(x, 'inner'), law, Ground(SLOPE)).mode
        for x in LANDINGS for law in LAWS
    }  # fmt: skip
    assert found == {'stick', 'slide', 'flight'}


@pytest.mark.parametrize('stance', STANCES)
def test_wide_cone_without_rebound_is_the_plastic_impact(bare, stance):
    x = landing_state(LANDINGS[0], stance)
    done = land(bare, stance, x, ContactLaw(0.0, 1e6), Ground(SLOPE))
    plain = impact(bare, stance, x)
    np.testing.assert_allclose(done.x_plus, plain.x_plus, rtol=1e-12)
    np.testing.assert_allclose(done.impulse, plain.impulse, rtol=1e-12)
    np.testing.assert_allclose(done.foot_velocity, plain.foot_velocity, rtol=1e-11)


def test_block_that_is_thrown_on_the_ground():
    """A point mass: worked out by hand."""
    W, ground = np.eye(2) / 3.0, Ground(0.0)
    impulse, then = contact_impulse(np.array([2.0, -1.0]), W, ContactLaw(0.0, 0.4), ground)
    np.testing.assert_allclose(impulse, [-1.2, 3.0])
    assert then == 'slide'
    impulse, then = contact_impulse(np.array([2.0, -1.0]), W, ContactLaw(0.5, 3.0), ground)
    np.testing.assert_allclose(impulse, [-6.0, 4.5])
    assert then == 'flight'
    slow = np.array([0.0, -REST_SPEED])
    assert contact_impulse(slow, W, ContactLaw(0.5, 3.0), ground)[1] == 'stick'


# --- the motion between ------------------------------------------------------------------------


def test_at_neutral_values_it_is_the_same_walk_to_the_bit(robot):
    neutral = robot.with_effect('impact_restitution', coefficient=0.0)
    neutral = neutral.with_effect('foot_slip', friction=math.inf)
    _, plain = stepping(robot, ContactLaw(), command=pull)
    x0 = section_state(np.array([0.2, 1.1, 0.0]), 'inner', SLOPE)
    same = walk(neutral, 'inner', x0, 0.75, pull, WalkOptions(slope=SLOPE))
    assert len(plain.impacts) == 1
    assert [arc.mode for arc in plain.arcs] == ['stick', 'stick']
    for a, b in zip(plain.arcs, same.arcs, strict=True):
        np.testing.assert_array_equal(a.states, b.states)


def test_limits_of_the_laws_are_the_plastic_walk(robot):
    _, plain = stepping(robot, ContactLaw(), command=pull)
    _, gripped = stepping(robot, ContactLaw(0.0, 5.0), command=pull)
    np.testing.assert_allclose(gripped.state, plain.state, rtol=1e-12)
    # A rebound below REST_SPEED is none.
    _, dead = stepping(robot, ContactLaw(1e-4), command=pull)
    np.testing.assert_allclose(dead.state, plain.state, rtol=1e-12)


@pytest.mark.parametrize('stance', STANCES)
def test_in_flight_the_centre_of_mass_falls_freely(bare, stance):
    """And what turns about it keeps its momentum, whatever the hip does."""
    _, done = stepping(bare, ContactLaw(0.3), command=pull, stance=stance)
    flight = next(arc for arc in done.arcs if arc.mode == 'flight')
    mass, g = bare.values['total_mass'], bare.values['gravity']
    linear, turning = [], []
    for x, foot in zip(flight.states, flight.foot, strict=True):
        bodies, _ = momenta(bare, flight.stance, x, foot[:2], foot[2:])
        centre = sum(m * place for m, place, *_ in bodies.bodies) / mass
        linear.append(bodies.linear_momentum())
        turning.append(bodies.angular_momentum(centre))
    time = flight.time - flight.time[0]
    assert time[-1] > 0.01
    linear = np.array(linear)
    # The step of 1 ms: its error is of order 1e-9.
    np.testing.assert_allclose(linear[:, 0], linear[0, 0], atol=1e-7)
    np.testing.assert_allclose(linear[:, 1], linear[0, 1] - mass * g * time, atol=1e-7)
    np.testing.assert_allclose(turning, turning[0], atol=1e-7)


@pytest.mark.parametrize('stance', STANCES)
def test_friction_is_all_that_moves_a_sliding_robot_along(bare, stance):
    law = ContactLaw(0.0, 0.3)
    _, done = stepping(bare, law, stance=stance, command=pull)
    slide = next(arc for arc in done.arcs if arc.mode == 'slide')
    ground = Ground(SLOPE)
    weight = bare.values['total_mass'] * bare.values['gravity'] * np.array([0.0, -1.0])
    gained, slips = [], slide.foot[:, 2:] @ ground.tangent
    for x, foot in zip(slide.states, slide.foot, strict=True):
        gained.append(momenta(bare, slide.stance, x, foot[:2], foot[2:])[0].linear_momentum())
    time = slide.time
    assert len(time) > 10
    np.testing.assert_allclose(slide.foot[:, :2] @ ground.normal, 0, atol=1e-10)
    assert (slips[:-1] > 0).all() or (slips[:-1] < 0).all()
    force = np.diff(gained, axis=0) / np.diff(time)[:, None] - weight
    along, off = force @ ground.tangent, force @ ground.normal
    assert (off > 0).all()
    # Mean forces over a step of the integrator; their ratio is that of the forces.
    np.testing.assert_allclose(along[:-1], -law.friction * np.sign(slips[0]) * off[:-1], rtol=1e-6)


@pytest.mark.parametrize(
    ('law', 'kinds'),
    [
        (ContactLaw(0.3), {'flight'}),
        (ContactLaw(0.0, 0.4), {'slide'}),
        (ContactLaw(0.2, 0.5), {'flight', 'slide'}),
    ],
)
def test_energy_never_rises_by_itself(bare, law, kinds):
    """A passive step, with all the parts that its stance phases fall into."""
    _, done = stepping(bare, law, start=(0.15, 1.0, -1.5))
    assert len(done.impacts) == 1
    assert kinds <= {arc.mode for arc in done.arcs}
    l, origin, foot, last = bare.values['leg_length'], np.zeros(2), np.zeros(4), math.inf
    stance = done.arcs[0].stance
    for arc in done.arcs:
        if arc.stance != stance:
            # Heights and places go on from the foot that was left.
            q, (old, new) = arc.states[0][:2], (STANCES.index(s) for s in (stance, arc.stance))
            hip = l * np.array([np.sin(q[old]), np.cos(q[old])])
            origin = origin + foot[:2] + hip - l * np.array([np.sin(q[new]), np.cos(q[new])])
            stance = arc.stance
        for x, foot in zip(arc.states, arc.foot, strict=True):
            now = energy(bare, stance, x, origin + foot[:2], foot[2:])
            assert now < last + 1e-7  # the integrator, of 160 J
            last = now


def test_bounces_die_out_and_the_foot_is_held(bare):
    _, done = stepping(bare, ContactLaw(0.3), command=pull)
    modes = [arc.mode for arc in done.arcs]
    bounces = [event for event in done.events if event.kind == 'bounce']
    assert len(bounces) >= 3
    assert modes == ['stick', *['flight'] * len(bounces), 'stick']
    speeds = [abs(e.impact.landing_velocity @ Ground(SLOPE).normal) for e in bounces[:-1]]
    assert (np.diff(speeds) < 0).all()
    assert speeds[-1] >= REST_SPEED
    for before, after in itertools.pairwise(done.arcs):
        np.testing.assert_array_equal(before.states[-1][:2], after.states[0][:2])


def test_foot_slips_in_stance_where_the_force_leaves_the_cone(bare):
    law, ground = ContactLaw(0.0, 0.16), Ground(SLOPE)
    _, done = stepping(bare, law, duration=0.5, command=pull)
    first = done.arcs[0]
    event = done.events[0]
    assert (event.kind, first.mode) == ('slip', 'stick')
    force = ground_reaction(bare, first.stance, first.states, first.inputs)
    ratio = np.abs(force @ ground.tangent) / (force @ ground.normal)
    assert (ratio[:-1] < law.friction).all()
    # A command may make the force jump; this one changes by little.
    assert ratio[-1] == pytest.approx(law.friction, rel=0.02)
    slide = done.arcs[1]
    assert slide.mode == 'slide'
    # The foot is driven against the force that held it.
    assert np.sign(slide.foot[3, 2]) == -np.sign(force[-1] @ ground.tangent)


def test_halving_the_step_of_a_slide_gains_the_order_of_the_integrator(bare):
    ends = [
        stepping(bare, ContactLaw(0.2, 0.3), duration=0.7, step=step, command=pull)[1].state
        for step in (2e-3, 1e-3, 2.5e-4)
    ]
    coarse, fine = (np.abs(end - ends[2]).max() for end in ends[:2])
    assert fine < 1e-6
    assert coarse < 1e-5
