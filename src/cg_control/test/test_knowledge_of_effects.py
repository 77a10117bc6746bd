"""What design model, compensation and planner know of an effect is what its class says."""

import numpy as np
import pytest

from cg_control.balancing.basin import modes_of
from cg_control.balancing.linearise import design_model
from cg_control.friction import FrictionCompensation, compensated
from cg_control.trajectories.collocation import planning_model, softened
from cg_description.paths import model_path
from cg_dynamics.effects import LIBRARY, UNMODELLED
from cg_dynamics.linearise import without_dry_friction, without_extra_states
from cg_dynamics.mechanisms import MECHANISMS
from cg_dynamics.model import Model

COMPASS = MECHANISMS['compass_gait']
EVERY = {n: cls for n, cls in (LIBRARY | UNMODELLED).items() if cls.sites(COMPASS)}
CONSUMERS = {
    'linear design': design_model,
    'elastic design': lambda model: design_model(model, elastic=True),
    'observer': lambda model: without_dry_friction(without_extra_states(model)),
    'plan with friction': planning_model,
    'plan without friction': lambda model: planning_model(model, friction=False),
    'coarse plan': softened,
}


@pytest.fixture
def bare(robot) -> Model:
    return robot.without_effect('coulomb_friction').without_effect('viscous_friction')


def renamed(monkeypatch, name: str) -> str:
    """The name of a class that differs from a library's by its name alone."""
    new = name[::-1]  # which holds no word that a consumer might look for
    monkeypatch.setitem(LIBRARY, new, type('Renamed', (EVERY[name],), {'name': new}))
    return new


def acting(name: str) -> dict[str, float]:
    """Values with which an effect acts."""
    first = EVERY[name].parameters[0]
    return {first.name: first.starts[0] if first.starts else 0.3}


@pytest.mark.parametrize('name', EVERY)
def test_a_name_tells_consumers_nothing(monkeypatch, bare, name):
    new = renamed(monkeypatch, name)
    known, other = (bare.with_effect(n, **acting(name)) for n in (name, new))
    for what, consumer in CONSUMERS.items():
        kept, seen = consumer(known), consumer(other)
        assert {label.replace(new, name): value for label, value in seen.values.items()} == (
            kept.values
        ), what
        assert seen.torque_limit == kept.torque_limit, what
    friction = [FrictionCompensation(model) for model in (known, other)]
    for angle, rate in ((0.3, 0.5), (-0.2, -1.5), (0.1, 0.004)):
        assert friction[0].taken(angle, rate) == friction[1].taken(angle, rate)
    modes = [modes_of(model, 'inner').to_modes for model in (known, other)]
    np.testing.assert_allclose(modes[1], modes[0], atol=1e-12)


@pytest.mark.parametrize('name', EVERY)
def test_consumers_agree_on_every_effect(bare, name):
    """What is left out of a plan is given back, and no dry friction is designed on."""
    model = bare.with_effect(name, **acting(name))
    (effect,) = model.effects
    assert not any(e.friction == 'dry' or e.ripple for e in design_model(model).effects)
    rubs, slides = planning_model(model), planning_model(model, friction=False)
    gone = {e.label for e in rubs.effects} - {e.label for e in slides.effects}
    assert bool(gone) == any(compensated(e) for e in without_extra_states(model).effects)
    taken = FrictionCompensation(model).taken(0.3, 0.5)
    assert not (taken and not gone)
    if name in LIBRARY and compensated(effect) and name != 'load_dependent_friction':
        # But what a clock or a switch decides.
        assert bool(taken > 0) != bool(effect.extra_inputs)


def test_two_frictions_of_a_kind_at_one_joint_add_up(monkeypatch, robot):
    new = renamed(monkeypatch, 'coulomb_friction')
    twice = robot.with_effect(new, torque=0.7)
    assert design_model(twice).values == design_model(robot).values
    assert planning_model(twice, friction=False).values == (
        planning_model(robot, friction=False).values
    )
    assert planning_model(twice).values[f'{new}.torque'] == 0.7
    assert (
        softened(twice).values[f'{new}.transition_rate']
        == (softened(robot).values['coulomb_friction.transition_rate'])
    )
    one, two = FrictionCompensation(robot), FrictionCompensation(twice)
    assert two.taken(0.0, 1.0) == pytest.approx(one.taken(0.0, 1.0) + 0.7)


def test_bristles_count_as_the_level_to_which_they_bend(robot):
    bent = robot.with_effect('presliding_friction', torque=0.6)
    assert planning_model(bent).values['coulomb_friction.torque'] == pytest.approx(1.84 + 0.6)
    one, two = FrictionCompensation(robot), FrictionCompensation(bent)
    assert two.taken(0.0, 1.0) == pytest.approx(one.taken(0.0, 1.0) + 0.6)


@pytest.mark.parametrize('name', ['joint_flexibility', 'backlash'])
def test_a_plan_keeps_the_inertia_of_a_rotor(robot, name):
    planned = planning_model(robot.with_effect(name, rotor_inertia=0.4))
    assert planned.values['rotor_inertia.inertia'] == 0.4


def test_friction_that_turns_with_the_joint_is_given_back_where_it_is(bare):
    model = bare.with_effect(
        'position_dependent_friction', torque=1.0, tightest=0.0, transition_rate=0.01
    )
    friction = FrictionCompensation(model)
    assert friction.taken(0.0, 1.0) == pytest.approx(1.0)
    assert friction.taken(np.pi, 1.0) == pytest.approx(0.0, abs=1e-12)


def test_a_joint_gives_back_its_own_friction_only():
    model = Model.load(model_path('dfki_double_pendulum'))
    model = model.with_effect('quadratic_friction', at='elbow', coefficient=0.2)
    shoulder, elbow = (FrictionCompensation(model, joint) for joint in ('shoulder', 'elbow'))
    without = FrictionCompensation(model.without_effect('quadratic_friction@elbow'), 'elbow')
    assert elbow.taken(0.0, 2.0) - without.taken(0.0, 2.0) == pytest.approx(0.2 * 4.0)
    assert shoulder.taken(0.0, 2.0) != elbow.taken(0.0, 2.0)


def test_a_drive_that_saturates_bounds_the_plan(robot):
    weak = planning_model(robot.with_effect('torque_saturation', limit=5.0))
    assert weak.torque_limit == 5.0
    assert planning_model(robot.with_effect('torque_saturation', limit=90.0)).torque_limit == 40.0
