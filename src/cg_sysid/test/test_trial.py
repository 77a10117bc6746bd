"""A record made ready for simulation: inputs as a model asks for them."""

import numpy as np

from cg_dynamics.compiled import compile_model
from cg_dynamics.model import Model
from cg_dynamics.rig import Setup
from cg_sysid.candidates import candidates_for
from cg_sysid.rehearse import rehearse
from cg_sysid.trial import prepare


def test_model_gets_torque_time_and_switches_in_its_order(model_file):
    nominal = Model.load(model_file)
    record = rehearse('swing', nominal, Setup('inner', 'inner_fixed'), [0.2, 0.5], [np.sin], 0.3)
    (trial,) = prepare(nominal, [record])
    asking = nominal.with_effect('friction_drift').with_effect('back_emf')
    names = compile_model(asking, trial.setup).input_names
    assert names == ('hip_torque', 'time', 'drive_enabled')
    inputs = trial.inputs_for(names)
    np.testing.assert_array_equal(inputs[:, 0], record.inputs['hip_torque'])
    np.testing.assert_array_equal(inputs[:, 1], trial.time)
    np.testing.assert_array_equal(inputs[:, 2], 1.0)


def test_only_effects_that_can_show_are_tried(model_file):
    nominal = Model.load(model_file)
    fixed = {name for name, _ in candidates_for(nominal, [Setup('inner', 'inner_fixed')])}
    free = {name for name, _ in candidates_for(nominal, [Setup()])}
    unseen = {'foot_radius', 'foot_compliance', 'ankle_friction', 'tether_force', 'external_push',
              'boom_mass'}  # fmt: skip
    assert free - fixed == unseen
    assert not {'spring_damping', 'spring_nonlinearity'} & free


def test_an_effect_of_a_switch_is_tried_where_the_switch_was_recorded(model_file):
    nominal = Model.load(model_file)
    without = {name for name, _ in candidates_for(nominal, [Setup()])}
    recorded = {name for name, _ in candidates_for(nominal, [Setup()], None, {'drive_enabled'})}
    assert recorded - without == {'back_emf'}
