"""Transversal surfaces: where they must be, what they cross, and how wide the tube is."""

from dataclasses import replace

import numpy as np
import pytest

from cg_control.orbits.orbit import plan_orbit
from cg_control.orbits.surfaces import (
    IMPACT,
    TORQUE,
    UNITS,
    between,
    phase_of,
    tube,
    with_planes,
    with_surfaces,
)
from cg_control.trajectories.collocation import Options, optimise
from cg_control.trajectories.task import Box, Task
from cg_control.trajectories.trajectory import Phase, TrajectoryError
from cg_dynamics.walking.hybrid import swing_foot

SLOPE = np.radians(-1.0)


@pytest.fixture(scope='module')
def gait(robot):
    """Uphill, so that twice the slope is not zero."""
    return plan_orbit(robot, 0.25, 0.35, SLOPE).trajectory


@pytest.fixture(scope='module')
def surfaces(gait, robot):
    return with_surfaces(gait, robot)


def test_ends_are_the_impact_surface(surfaces, robot):
    """A state on the last plane, or the first, has both feet on the ground, and the reverse."""
    l, rng = robot.values['leg_length'], np.random.default_rng(0)
    for phase in surfaces.phases:
        for end, direction in ((0, 'lifts'), (-1, 'comes down')):
            n, x0 = phase.normals[end], phase.states[end]
            x = x0 + rng.normal(scale=0.1, size=(20, 4))
            x -= np.outer((x - x0) @ n / (n @ n), n)
            for state in x:
                reach, rise = swing_foot(state, phase.stance, l)
                assert abs(rise + reach * np.tan(SLOPE)) < 1e-9
            # Crossed upward: after an impact the foot behind lifts, before one it lands ahead.
            reach, rise = swing_foot(x0 + 1e-5 * phase.rates[end], phase.stance, l)
            height = rise + reach * np.tan(SLOPE)
            assert phase.rates[end] @ IMPACT > 0
            assert (height > 0 > reach) if direction == 'lifts' else (height < 0 < reach)


def test_planes_cross_the_motion_at_unit_rate(surfaces):
    for phase in surfaces.phases:
        crossing = (phase.normals * phase.rates).sum(axis=1)
        np.testing.assert_allclose(crossing, 1.0, atol=1e-12)
        assert with_planes(phase) == [(0, len(phase.time) - 1)]
        # Between knots only up to interpolation.
        points = between(phase, 0.5)
        crossing = (points.normals * points.rates).sum(axis=1)
        assert np.abs(crossing - 1).max() < 0.1


def test_points_between_knots_are_those_of_the_phase(surfaces):
    phase, step = surfaces.phases[1], 1e-6
    points = between(phase, 0.3)
    for k, t in enumerate(phase.time[:-1] + 0.3 * np.diff(phase.time)):
        at, early, late = (phase.at(t + shift) for shift in (0.0, -step, step))
        np.testing.assert_allclose(points.states[k], at.state, atol=1e-12)
        np.testing.assert_allclose(points.normals[k], at.normal, atol=1e-9)
        np.testing.assert_allclose(points.rates[k], (late.state - early.state) / 2 / step,
                                   atol=1e-6)  # fmt: skip
        np.testing.assert_allclose(points.turning[k], (late.normal - early.normal) / 2 / step,
                                   atol=1e-5 * np.abs(phase.normals).max())  # fmt: skip


def test_planes_meet_where_the_tube_ends(surfaces, robot):
    """Inside, a state has one phase near its own; at the radius planes pass through each other."""
    rng = np.random.default_rng(1)
    for phase, radii in zip(surfaces.phases, tube(surfaces, robot), strict=True):
        least, step = radii.well_posed.min(), 1e-6
        for share in (0.01, 0.4, 0.99):
            points = between(phase, share)
            for k in range(0, len(phase.time) - 1, 4):
                n = points.normals[k]
                d = rng.normal(size=(200, 4))
                d -= np.outer(d @ (n * UNITS) / ((n * UNITS) ** 2).sum(), n * UNITS)
                d *= (least / np.linalg.norm(d, axis=1))[:, None]
                for scale in (0.98, -0.98):
                    x = points.states[k] + scale * d * UNITS
                    # dg/ds of g = n'(x - x0), by differences: falls everywhere inside.
                    nearby = points.normals[k] + step * points.turning[k]
                    later = points.states[k] + step * points.rates[k]
                    fall = ((x - later) @ nearby - (x - points.states[k]) @ n) / step
                    assert fall.max() < 0
        # The radius is reached: in the worst direction at the worst place the planes meet.
        assert np.isfinite(least)


def test_the_worst_direction_ends_the_phase(surfaces, robot):
    """Just beyond (TUBE) the denominator of ds/dt is negative, just inside positive."""
    for phase, radii in zip(surfaces.phases, tube(surfaces, robot), strict=True):
        for share in (0.0, 0.5, 1.0):
            points = between(phase, share)
            n, g = points.normals * UNITS, points.turning * UNITS
            for k in range(len(n)):
                # Largest g'd over |d| <= 1 with n'd = 0, by the null space of n.
                basis = np.linalg.svd(n[k][None])[2][1:]
                along = np.linalg.norm(basis @ g[k])
                radius = points.normals[k] @ points.rates[k] / along
                assert radius >= min(radii.well_posed[k : k + 2]) * (1 - 1e-9)


def test_phase_advances_up_to_its_radius(surfaces, robot):
    """To first order by construction; the exact model keeps it to half of that."""
    from exact_motion import rates

    from cg_control.orbits.surfaces import design_of

    design, rng = design_of(surfaces, robot), np.random.default_rng(2)
    for phase, radii in zip(surfaces.phases, tube(surfaces, robot), strict=True):
        for k in range(len(phase.time)):
            n = phase.normals[k] * UNITS
            d = rng.normal(size=(100, 4))
            d -= np.outer(d @ n / (n @ n), n)
            d *= (0.5 * radii.advancing[k] / np.linalg.norm(d, axis=1))[:, None]
            x = phase.states[k] + d * UNITS
            f = rates(design, phase.stance, x, np.full(len(x), phase.torque[k]))
            assert (f @ phase.normals[k]).min() > 0


def test_widest_is_wider_than_a_blend(gait, surfaces, robot):
    """Against planes that go from the impact surface to the flow and back in a straight way."""
    blended = []
    for phase in gait.phases:
        flow = phase.rates / UNITS**2
        flow /= np.linalg.norm(flow * UNITS, axis=1)[:, None]
        share = np.linspace(0, 1, len(phase.time))
        near = np.maximum(0, 1 - 4 * np.minimum(share, 1 - share))[:, None]
        n = near * IMPACT / np.linalg.norm(IMPACT * UNITS) + (1 - near) * flow
        blended.append(replace(
            phase, normals=n / (n * phase.rates).sum(axis=1, keepdims=True)
        ))  # fmt: skip
    blended = gait.with_phases(tuple(blended))

    def least(motion):
        both = [np.hypot(1 / t.advancing, TORQUE / t.torque) for t in tube(motion, robot)]
        return min(
            min(t.well_posed.min(), 1 / size.max())
            for t, size in zip(tube(motion, robot), both, strict=True)
        )

    assert least(surfaces) > 1.1 * least(blended)


def test_planes_do_not_depend_on_how_finely_the_motion_is_cut(gait, surfaces, robot):
    halved = []
    for phase in gait.phases:
        time = np.sort(np.concatenate([phase.time, (phase.time[1:] + phase.time[:-1]) / 2]))
        points, middle = [phase.at(t) for t in time], between(phase, 0.5)
        rates = np.empty((len(time), 4))
        rates[::2], rates[1::2] = phase.rates, middle.rates
        halved.append(Phase(phase.stance, time, [p.state for p in points], rates,
                            [p.torque for p in points]))  # fmt: skip
    fine = with_surfaces(gait.with_phases(tuple(halved)), robot)
    for a, b in zip(tube(surfaces, robot), tube(fine, robot), strict=True):
        for name in ('well_posed', 'advancing'):
            coarse, finer = getattr(a, name).min(), getattr(b, name).min()
            assert finer == pytest.approx(coarse, rel=0.15)


def test_planes_normal_to_the_flow(gait, robot):
    for phase in with_surfaces(gait, robot, 'flow').phases:
        n, flow = phase.normals * UNITS, phase.rates / UNITS
        cosine = (n * flow).sum(axis=1) / np.linalg.norm(n, axis=1) / np.linalg.norm(flow, axis=1)
        np.testing.assert_allclose(cosine, 1.0, atol=1e-12)


def test_phase_is_that_of_the_plane_that_holds_the_state(surfaces):
    rng = np.random.default_rng(3)
    for phase in surfaces.phases:
        for s in rng.uniform(phase.start, phase.end, size=10):
            point = phase.at(s)
            d = 0.3 * rng.uniform(-1, 1, size=4) * UNITS
            x = point.state + d - point.normal * (point.normal @ d) / (point.normal @ point.normal)
            for away in (-0.03, 0.0, 0.03):
                assert phase_of(phase, x, s + away) == pytest.approx(s, abs=1e-9)
        beyond = phase.states[-1] + 0.01 * phase.rates[-1]
        assert phase_of(phase, beyond, phase.end) == phase.end


def test_a_step_in_from_rest(gait, robot):
    """It begins with no rate, and ends on the impact surface of the orbit."""
    goal = Box.point(gait.phases[1].states[-1])
    task = Task(('outer',), goal=goal, durations=(0.2, 2.0), slope=SLOPE)
    motion = with_surfaces(
        optimise(robot, task, Options(fine=20), friction=False), robot, torque=10.0
    )
    (phase,) = motion.phases
    np.testing.assert_allclose(
        phase.normals[-1] / np.linalg.norm(phase.normals[-1]), IMPACT / np.sqrt(2), atol=1e-9
    )
    assert min(tube(motion, robot)[0].well_posed) > 0.3


def test_where_the_motion_rests_there_are_no_planes(gait, robot):
    """A robot that waits for half a second before it moves has the clock for its phase."""
    phase = gait.phases[0]
    still = phase.states[0] * [1, 1, 0, 0]
    wait = np.linspace(-0.5, -0.1, 5) + phase.start
    waiting = Phase(
        phase.stance, np.concatenate([wait, phase.time]),
        np.vstack([np.tile(still, (5, 1)), phase.states]),
        np.vstack([np.zeros((5, 4)), phase.rates]), np.concatenate([np.zeros(5), phase.torque]),
    )  # fmt: skip
    motion = replace(gait, phases=(waiting,), provenance={'slope': 0.0})
    (found,) = with_surfaces(motion, robot).phases
    assert not found.normals[:5].any()
    assert with_planes(found) == [(5, len(found.time) - 1)]
    assert phase_of(found, found.states[2] + 0.1, found.time[2]) == found.time[2]


def test_what_cannot_be_is_refused(gait, robot):
    with pytest.raises(ValueError, match='method is'):
        with_surfaces(gait, robot, 'nearest')
    with pytest.raises(TrajectoryError, match='does not cross'):
        with_surfaces(gait, robot, last=-IMPACT)
    with pytest.raises(TrajectoryError, match='plan it again'):
        with_surfaces(gait, robot.with_values({'c1': 0.101}))
