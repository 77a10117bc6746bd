"""Learning from walking: what the walking robot lacks in its model is named from its walk.

A robot carries a payload that nobody wrote down, and walks under the tree of its nominal model in
the lock-step loop. Bags of these walks, with the note of a live recorder, go to the diagnosis as
any other.
"""

import numpy as np
import pytest

from cg_bringup.balancing import balance, record_of
from cg_control.balancing.balance import BalanceController, balance_gains
from cg_control.balancing.basin import shipped_basins
from cg_control.following.tracking import WALKING
from cg_control.trees.recovery import ReadyTree, RecoverySettings, TreeController
from cg_control.trees.tree import Tree
from cg_control.trees.tree_files import tree_path
from cg_description.paths import model_path
from cg_dynamics.model import Model
from cg_dynamics.plant import Plant
from cg_dynamics.rig import Setup
from cg_estimation.high_gain import HighGainObserver
from cg_sysid.checks.loading import load_bags
from cg_sysid.diagnosis.diagnose import diagnose
from cg_sysid.diagnosis.result import Options
from cg_sysid.records.bags import write_bag
from cg_sysid.search.ranking import effect_name

pytestmark = [pytest.mark.evidence, pytest.mark.xdist_group('learning_from_walks')]

MODEL_FILE = model_path('compass_gait_mit')
T = 0.002
MASS = 1.0  # kg, hidden; the robot has 15
CANDIDATES = ('payload', 'torque_bias', 'torque_constant', 'actuator_lag')
# Leg that stands first, speed in m/s, s: four steps each. At 0.2 m/s the model without the payload
# misses most of what both feet could explain.
WALKS = (('inner', 0.2, 6.6), ('outer', 0.25, 6.0))


def walked(nominal, robot, stance, speed, duration):
    """The run of the loop and its record."""
    settings = RecoverySettings(
        speed=speed, steps=100, remedy=WALKING.remedy, pull=100.0, fastest=WALKING.fastest
    )
    gains = balance_gains(nominal, settings, T)
    basins = shipped_basins(nominal, gains, nominal.torque_limit)
    controller = TreeController(BalanceController(nominal, settings, gains, basins), settings)
    tree = Tree.load(tree_path('compass_gait_mit_walk'), nominal)
    controller.take(ReadyTree.of(tree, nominal, T))
    setup = Setup(stance=stance, on_blocks=False)
    plant = Plant(robot, setup, np.zeros(4), T, seed=100)
    run = balance(plant, HighGainObserver(nominal, setup, 0.01), controller, duration)
    return run, record_of(f'walk_{stance}', run, setup)


@pytest.fixture(scope='module')
def learnt(tmp_path_factory):
    """The runs, what was taken in of their bags, and the diagnosis."""
    nominal = Model.load(MODEL_FILE)
    robot = nominal.with_effect('payload', 'inner', mass=MASS, distance=0.6)
    done = [walked(nominal, robot, *walk) for walk in WALKS]
    folder = tmp_path_factory.mktemp('walks')
    bags = [write_bag(folder / record.name, record) for _, record in done]
    loaded = load_bags(bags, MODEL_FILE)
    options = Options(effects=CANDIDATES, workers=1)
    found = diagnose(nominal, loaded.records, options, landings=loaded.landings)
    return [run for run, _ in done], loaded, found


@pytest.mark.slow
def test_every_step_of_the_walk_is_found_where_it_was(learnt):
    runs, loaded, _ = learnt
    assert not loaded.left_out
    for source in loaded.sources:
        assert 'closed_loop' in {finding.code for finding in source.check.findings}
    for source, run in zip(loaded.sources, runs, strict=True):
        true = run.time[1:][np.diff(run.standing) != 0]
        found = [
            landing.touchdown.time for landing in loaded.landings
            if loaded.origin[landing.record.name] == source.name
        ]  # fmt: skip
        assert len(true) >= 4
        # A few samples, as on slopes (test_phases.py).
        np.testing.assert_allclose(found, true, rtol=0, atol=0.012)


@pytest.mark.slow
def test_the_payload_is_among_what_is_named_from_the_walk(learnt):
    """A walk weighs the robot by its motor: heavier, or the motor weaker, it cannot tell."""
    _, _, found = learnt
    assert len(found.causes) == 1, found.summary
    (cause,) = found.causes
    assert 'payload' in {cause.label, *cause.rivals, *cause.places}
    assert {effect_name(r) for r in (cause.label, *cause.rivals)} <= {'payload', 'torque_constant'}
    whole = found.nominal.values['total_mass']
    if cause.label == 'torque_constant':
        value, sigma, _ = cause.parameters['error']
        true = whole / (whole + MASS) - 1.0
    else:
        value, sigma, _ = cause.parameters['mass']
        true = MASS
    assert abs(value - true) < 3 * sigma
    assert sigma < 0.1 * abs(true)
    # Down to the noise on what was held out, and the ground is sound.
    assert found.extended.held.normalised_error < 1.3
    assert found.landings is not None
    assert not found.landings.accepted
