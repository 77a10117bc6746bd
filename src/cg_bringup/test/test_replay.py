"""A recording replayed gives the estimates that the loop had."""

import numpy as np
import pytest

from cg_bringup.balancing import balance
from cg_bringup.replay import main, replay_record
from cg_control.balancing.balance import BalanceController, BalanceSettings, balance_gains
from cg_description.paths import model_path
from cg_dynamics.model import Model
from cg_dynamics.plant import Plant
from cg_dynamics.rig import Setup
from cg_estimation.high_gain import HighGainObserver
from cg_estimation.observer_settings import ObserverSettings
from cg_sysid.records.bags import read_bag, write_bag
from cg_sysid.records.record import Record

MODEL = Model.load(model_path('compass_gait_mit'))
SETUP = Setup(stance='outer')


@pytest.fixture(scope='module')
def recorded(tmp_path_factory):
    settings = BalanceSettings()
    motion = balance(
        Plant(MODEL, SETUP, np.array([0.03, 0.03, 0.0, 0.0]), seed=2),
        HighGainObserver(MODEL, SETUP, 0.1),
        BalanceController(MODEL, settings, balance_gains(MODEL, settings, 0.002)),
        1.0,
    )
    stamps = 10**9 + np.round(motion.time * 1e9).astype(np.int64)
    record = Record(
        'run', stamps, {'hip_torque': motion.torque}, motion.readings, 'compass_gait', SETUP
    )
    return motion, write_bag(tmp_path_factory.mktemp('bags') / 'run', record)


def test_replay_of_a_bag_is_what_the_loop_knew(recorded):
    motion, bag = recorded
    _, states, _ = replay_record(read_bag(bag), ObserverSettings(epsilon=0.1))
    # The lean travels as a quaternion: rounding, amplified by the friction's slope of 184.
    np.testing.assert_allclose(states, motion.estimates, atol=1e-9)


def test_command_line_writes_a_row_for_every_measurement(recorded, tmp_path, capsys):
    _, bag = recorded
    out = tmp_path / 'states.csv'
    assert main([str(bag), '--epsilon', '0.02', '--use_gyro', '--out', str(out)]) == 0
    table = np.genfromtxt(out, delimiter=',', names=True, deletechars='')
    assert len(table) == 500
    assert list(table.dtype.names) == [
        'stamp_ns', 'q_inner', 'q_outer', 'dq_inner/dt', 'dq_outer/dt',
    ]  # fmt: skip
    assert main([str(bag), '--epsilon', '-1', '--out', str(out)]) == 2
    assert 'epsilon is -1.0; allowed is' in capsys.readouterr().err
