"""Effects hidden in a machine that shares no code with the model: the robot in MuJoCo.

MuJoCo integrates its own rigid bodies at its own step; only signs and angles have the same
meaning. The robot has no hip body there (mujoco_robot.two_links). All 31 kinds, a flexible joint
among them, are in bench/foreign_laws.py; bench/outside.py counts.
"""

import numpy as np
import pytest

pytest.importorskip('mujoco', reason='MuJoCo is not installed')

from mujoco_robot import Hidden, simulate_mujoco, two_links

from cg_description.paths import model_path
from cg_dynamics.model import Model
from cg_dynamics.rig import Setup
from cg_sysid.diagnosis.diagnose import diagnose
from cg_sysid.diagnosis.result import Options
from cg_sysid.experiments.excitation import ExcitationSettings, make_signal
from cg_sysid.records.record import Record

SAMPLE = 0.004
DURATION = 4.0
NOISE = {'imu_angle': 5e-4, 'imu_rate': 5e-3, 'hip_angle': 1e-4}


def springs(leg):
    return [
        {'body': leg, 'point': 1.0, 'anchor': [x, 1.0], 'stiffness': 200.0, 'free_length': 0.5}
        for x in (1.3, -1.3)
    ]


SETUPS = {
    'springs_inner': ({'stance': 'inner', 'springs': springs('inner')}, [0.1, -0.1, 0.5, -1.0]),
    'springs_outer': ({'stance': 'outer', 'springs': springs('outer')}, [0.1, -0.1, -0.8, 0.5]),
    'inner_fixed': ({'stance': 'inner', 'fixture': 'inner_fixed'}, [0.2, 0.5]),
    'outer_fixed': ({'stance': 'outer', 'fixture': 'outer_fixed'}, [-0.2, 0.5]),
}


def nominal_and_truth(seed):
    """The nominal robot without a hip body, and the true numbers, 10 to 15 % off."""
    file = Model.load(model_path('compass_gait_mit'))
    nominal = file.with_values(two_links(file.values))
    rng = np.random.default_rng(seed)
    truth = dict(nominal.values)
    for name in ('c1', 'c2', 'c4', 'c5'):
        truth[name] *= float(1 + rng.choice([-1, 1]) * rng.uniform(0.1, 0.15))
    return nominal, truth


def record(name, truth, hidden, seed):
    setup, motion = SETUPS[name]
    setup = Setup.from_dict(setup)
    signal = make_signal(
        ExcitationSettings(amplitude=6.0, f_max=3.0, duration=DURATION, seed=seed)
    )
    torque = np.array([signal(k * SAMPLE) for k in range(round(DURATION / SAMPLE))])
    rigid = {k: v for k, v in truth.items() if '.' not in k}
    out = simulate_mujoco(rigid, setup, torque, SAMPLE, np.array(motion), hidden, seed)
    return Record(
        name=f'{name}_{seed}',
        stamp_ns=(out['time'] * 1e9).round().astype(np.int64),
        inputs={'hip_torque': out['hip_torque']},
        outputs={channel: out[channel] for channel in NOISE},
        mechanism='compass_gait',
        setup=setup,
    )


HIDDEN = {
    'none': {},
    'gyro_bias': {'offsets': {'imu_rate': 0.04}},
    'quadratic_friction': {'at_hip': lambda t, angle, rate, torque: -0.3 * rate * abs(rate)},
}


HIDDEN_SEEDS = {'none': 40, 'gyro_bias': 42, 'quadratic_friction': 43}
NEAREST = (
    'quadratic_friction', 'asymmetric_friction', 'load_dependent_friction', 'stribeck_friction',
    'back_emf', 'torque_constant', 'aerodynamic_drag', 'gyro_bias', 'torque_bias',
)  # fmt: skip


@pytest.mark.slow
@pytest.mark.parametrize(
    ('effect', 'candidates'),
    [
        ('none', None),
        pytest.param('quadratic_friction', NEAREST, marks=pytest.mark.evidence),
        pytest.param('gyro_bias', NEAREST, marks=pytest.mark.evidence),
        pytest.param('quadratic_friction', None, marks=pytest.mark.evidence),
        pytest.param('gyro_bias', None, marks=pytest.mark.evidence),
    ],
)
def test_an_effect_hidden_in_mujoco_is_named(effect, candidates):
    """Among what comes nearest, and in bench/evidence.py in the whole library (None)."""
    seed = HIDDEN_SEEDS[effect]
    nominal, truth = nominal_and_truth(seed)
    hidden = Hidden(
        viscous=truth['viscous_friction.coefficient'],
        coulomb=truth['coulomb_friction.torque'],
        transition_rate=truth['coulomb_friction.transition_rate'],
        noise=NOISE,
        **HIDDEN[effect],
    )
    records = [record(name, truth, hidden, 10 * seed + i) for i in range(2) for name in SETUPS]
    found = diagnose(nominal, records, Options(effects=candidates, workers=1))
    named = {cause.label.partition('@')[0] for cause in found.causes}
    if effect == 'none':
        assert found.verdict == 'consistent', found.summary
        return
    rivals = {rival.partition('@')[0] for cause in found.causes for rival in cause.rivals}
    assert named | rivals == {effect}, found.summary
    assert found.extended.held.normalised_error < 0.5 * found.baseline.held.normalised_error
