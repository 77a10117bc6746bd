"""What the joints do in the mean of a window of a measured motion."""

from dataclasses import replace

import numpy as np
import pytest
from hanging_arm import nominal, recorded

from cg_sysid.identification.data_set import prepare
from cg_sysid.identification.torque_error import fit_by_torque, problems_of
from cg_sysid.identification.unknowns import unknowns_of
from cg_sysid.identification.window_torque import WindowTorque

OFF = {
    'thigh_mass': 1.12, 'shank_mass': 0.9, 'coulomb_friction@hip_joint.torque': 0.3,
    'viscous_friction@shank_joint.coefficient': 0.16, 'coulomb_friction@thigh_joint.torque': 0.11,
}  # fmt: skip
STRIBECK = {'torque': 0.3, 'stribeck_rate': 0.4}


@pytest.fixture(scope='module')
def machine():
    return nominal().with_values(OFF).with_effect('stribeck_friction', 'thigh_joint', **STRIBECK)


@pytest.fixture(scope='module')
def data_sets(machine):
    return prepare(nominal(), [recorded(machine, 6.0, seed) for seed in (1, 2)])


def test_where_friction_turns_the_mean_of_a_window_tells_what_its_mean_motion_does_not(
    machine, data_sets
):
    (problem,) = problems_of(machine, data_sets, ())
    rate, p = problem.motion.rate, problem.vector
    turns = np.zeros(rate.shape, bool)
    turns[1:] = (rate[1:] * rate[:-1] < 0) & ~problem.motion.first[1:, None]
    turns[:-1] |= turns[1:]
    whole, at_mean_motion = problem.residual(p), problem.error(p)[:, :, 0]
    for k in range(3):
        assert turns[:, k].sum() > 20
        # Noise of the encoders is left: 0.14 to 0.35 of it.
        there = [np.sqrt(np.mean(r[turns[:, k], k] ** 2)) for r in (whole, at_mean_motion)]
        assert there[0] < 0.5 * there[1]


def test_friction_is_found_as_large_as_it_is(machine, data_sets):
    found = fit_by_torque(machine, data_sets).values
    # At the mean motion of windows of 0.12 s it came to 0.23 N m.
    assert found['stribeck_friction@thigh_joint.torque'] == pytest.approx(0.3, rel=0.05)
    assert found['stribeck_friction@thigh_joint.stribeck_rate'] == pytest.approx(0.4, rel=0.05)
    assert found['coulomb_friction@hip_joint.torque'] == pytest.approx(0.3, rel=0.02)


def test_its_derivative_is_that_of_differences(machine, data_sets):
    names = (
        'stribeck_friction@thigh_joint.stribeck_rate', 'coulomb_friction@hip_joint.torque',
        'viscous_friction@shank_joint.coefficient', 'thigh_mass',
    )  # fmt: skip
    unknowns = [u for u in unknowns_of(machine) if u.name in names]
    assert len(unknowns) == len(names)
    (problem,) = problems_of(machine, data_sets, unknowns)
    p = problem.vector
    plain = p[: problem.equations.p.shape[0]]
    slope = problem.within.slope(plain)
    for i, (u, place) in enumerate(zip(unknowns, problem.places, strict=True)):
        step = 1e-6 * np.eye(len(plain))[place]
        differences = (problem.within(plain + step) - problem.within(plain - step)) / 2e-6
        # Rounding of 1e-14 over the step is 1e-8; curvature over it is less than 1e-6.
        assert slope[:, :, i] == pytest.approx(differences, abs=1e-6)
        assert np.any(slope[:, :, i]) == ('friction' in u.name)


def test_what_is_linear_in_a_chattering_torque_is_nothing(machine, data_sets):
    (problem,) = problems_of(machine, data_sets, ())
    e, motion = problem.equations, problem.motion
    chatter = 50 * (-1.0) ** np.arange(len(motion.records[0].inputs))
    records = [replace(s, inputs=s.inputs + chatter[:, None]) for s in motion.records]
    within = WindowTorque(e, 1.3 * e.u[:3], replace(motion, records=tuple(records)), ())
    # 50 N m at each sample, added and taken away: a hundred roundings.
    assert np.abs(within(problem.vector[: e.p.shape[0]])).max() < 1e-12


def test_it_follows_the_records_of_a_motion(machine, data_sets):
    (both,) = problems_of(machine, data_sets, ())
    alone = [problems_of(machine, [data_set], ())[0] for data_set in data_sets]
    plain = both.vector[: both.equations.p.shape[0]]
    assert np.array_equal(both.within(plain), np.vstack([p.within(plain) for p in alone]))
