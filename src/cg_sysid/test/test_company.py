"""A model in company simulates what it simulates alone."""

import numpy as np
import pytest

from cg_description.paths import model_path
from cg_dynamics.effects import LIBRARY
from cg_dynamics.model import Model
from cg_dynamics.rig import Setup, Spring
from cg_dynamics.rollout.compiled import compile_model
from cg_sysid.diagnosis.by_recording import with_own
from cg_sysid.experiments.rehearsal import rehearse
from cg_sysid.identification.company import in_company
from cg_sysid.identification.data_set import prepare
from cg_sysid.identification.simulation_error import Problem, attempt
from cg_sysid.identification.unknowns import unknowns_of

SPRINGS = (
    Spring('inner', 0.8, (-1.1, 0.7), 900.0, 0.9),
    Spring('inner', 0.7, (1.2, 0.6), 850.0, 1.0),
)
MACHINES = {
    'compass_gait_mit': (Setup(stance='inner', springs=SPRINGS), [0.03, 0.2, 0.1, -0.4]),
    'sydney_pendulum': (Setup(), [0.5, -0.3]),
    'dfki_double_pendulum': (Setup(), [0.5, -0.4, 0.3, 0.7]),
}


def recorded(name):
    """A model and a record of its machine, half a second long."""
    model = Model.load(model_path(name))
    setup, start = MACHINES[name]
    torque = [lambda t: 0.3 * np.sin(17 * t)] * len(model.mechanism.inputs)
    return model, prepare(model, [rehearse('a', model, setup, start, torque, 0.5, 0.002, 1)])


def on_top(model, effect, at):
    """The model with an effect of some size; None where it has that already."""
    made = LIBRARY[effect](model.mechanism, at)
    if any(made.label == other.label for other in model.effects):
        return None
    size = made.parameters[0]
    return model.with_effect(effect, at, **{size.name: (size.starts or (size.scale,))[0]})


def in_companies(name):
    """Effects and places on top of a machine's model that have company there."""
    model = Model.load(model_path(name))
    found = [
        (kind, at) for kind, effect in LIBRARY.items() for at in effect.sites(model.mechanism)
    ]
    made = [(candidate, on_top(model, *candidate)) for candidate in found]
    return [candidate for candidate, m in made if m is not None and in_company(m)[0] is not m]


@pytest.mark.parametrize(
    ('name', 'effect', 'at'), [(n, *candidate) for n in MACHINES for candidate in in_companies(n)]
)
def test_the_others_change_nothing(name, effect, at):
    model, data_sets = recorded(name)
    model = on_top(model, effect, at)
    unknowns = unknowns_of(model)
    theta = np.array([u.to_coordinate(u.prior) for u in unknowns])
    guesses = [data_set.motion for data_set in data_sets]
    alone, beside = (
        attempt(
            Problem(model, data_sets, unknowns, guesses, company=company), theta, guesses, 9
        ).point(1)
        for company in (False, True)
    )
    # The same sums in another order: of 76 cases the worst was off by 2.4e-14.
    assert beside.cost == pytest.approx(alone.cost, rel=1e-11)
    scale = np.sqrt(np.diag(alone.shared_hessian).clip(1e-30))
    gradients = (point.shared_gradient / scale for point in (beside, alone))
    np.testing.assert_allclose(*gradients, atol=1e-11 * np.sqrt(alone.cost))
    curvatures = (point.shared_hessian / np.outer(scale, scale) for point in (beside, alone))
    np.testing.assert_allclose(*curvatures, atol=1e-11)


def test_one_compiled_model_serves_all_of_a_place():
    model, data_sets = recorded('compass_gait_mit')
    setup = data_sets[0].setup
    built = [
        compile_model(in_company(on_top(model, effect, None))[0], setup)
        for effect in ('stribeck_friction', 'torque_bias', 'asymmetric_friction')
    ]
    assert built[0] is built[1] is built[2]


def test_a_size_of_each_recording_has_the_same_company():
    model, data_sets = recorded('compass_gait_mit')
    setup = data_sets[0].setup
    built = [
        compile_model(in_company(m)[0], setup)
        for m in (
            on_top(model, 'torque_bias', None),
            with_own(model, 'torque_bias', None, model),
            with_own(model, 'stribeck_friction', None, model),
        )
    ]
    assert built[0] is built[1] is built[2]


def test_who_has_states_of_its_own_is_alone():
    model, _ = recorded('compass_gait_mit')
    flexible = on_top(model, 'joint_flexibility', None)
    assert in_company(flexible) == (flexible, flexible)
