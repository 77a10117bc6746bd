"""A joint that slides: the units of every law follow it, in the model and in its file."""

import re

import numpy as np
import pytest
from cart_pole import FILE, CartPole, cart, install

from cg_dynamics.effects import LIBRARY, UNMODELLED, make_effect
from cg_dynamics.mechanisms import MECHANISMS
from cg_dynamics.model import Model, ModelError
from cg_dynamics.parameter import sliding_unit
from cg_dynamics.rig import Setup
from cg_dynamics.rollout.compiled import simulate

CART = CartPole()
ALONG = [
    (name, site)
    for name, effect in (LIBRARY | UNMODELLED).items()
    for site in effect.sites(CART)
    if site in ('rail', 'position', 'rail:cart', 'position:force')
]
ANGULAR = re.compile(r'rad|N m|kg m')


@pytest.fixture(autouse=True)
def known(monkeypatch):
    install(monkeypatch)


@pytest.mark.parametrize(
    ('turning', 'sliding'),
    [('N m', 'N'), ('N m s/rad', 'N s/m'), ('N m s^2/rad^2', 'N s^2/m^2'), ('N m/rad', 'N/m'),
     ('kg m^2', 'kg'), ('rad/s', 'm/s'), ('s', 's'), ('1', '1'), ('kg', 'kg'), ('N s/m', 'N s/m')],
)  # fmt: skip
def test_unit_along_a_rail(turning, sliding):
    assert sliding_unit(turning) == sliding


@pytest.mark.parametrize(('name', 'site'), ALONG)
def test_no_law_at_the_rail_has_a_unit_of_turning(name, site):
    """But a phase is an angle everywhere, and its waves are counted in rad/m."""
    effect = make_effect(name, CART, site)
    for parameter in effect.parameters:
        if parameter.name in ('phase', 'tightest', 'cycles'):
            continue
        assert not ANGULAR.search(parameter.unit), f'{effect.label}.{parameter.name}'


@pytest.mark.parametrize(
    ('name', 'site', 'units'),
    [
        ('coulomb_friction', 'rail', {'torque': 'N', 'transition_rate': 'm/s'}),
        ('viscous_friction', 'rail', {'coefficient': 'N s/m'}),
        ('joint_flexibility', 'rail',
         {'stiffness': 'N/m', 'rotor_inertia': 'kg', 'damping': 'N s/m'}),
        ('backlash', 'rail', {'gap': 'm', 'stiffness': 'N/m'}),
        ('cogging_torque', 'rail', {'amplitude': 'N', 'cycles': 'rad/m', 'phase': 'rad'}),
        ('position_dependent_friction', 'rail', {'torque': 'N', 'tightest': 'rad'}),
        ('torque_saturation', 'rail', {'limit': 'N', 'roundness': '1'}),
        ('encoder_offset', 'position', {'offset': 'm'}),
        ('encoder_offset', 'angle', {'offset': 'rad'}),
        ('unmodelled_joint_damping_of_angle', 'rail', {'c0': 'N s/m', 'low': 'm'}),
        ('unmodelled_joint_torque_of_body_angle', 'rail:pole', {'c0': 'N', 'low': 'rad'}),
        ('unmodelled_angle_error_of_torque', 'position:force', {'c0': 'm', 'high': 'N'}),
        ('unmodelled_angle_error_of_angle', 'angle:position', {'c0': 'rad', 'high': 'm'}),
        ('unmodelled_angle_error_of_rate', 'position', {'c0': 'm', 'high': 'm/s'}),
    ],
)  # fmt: skip
def test_units_of_laws(name, site, units):
    found = {p.name: p.unit for p in make_effect(name, CART, site).parameters}
    assert {key: found[key] for key in units} == units


def test_joints_that_turn_keep_their_units():
    for mechanism in MECHANISMS.values():
        for name, effect in LIBRARY.items():
            for site in () if mechanism.name == 'cart_pole' else effect.sites(mechanism):
                assert make_effect(name, mechanism, site).parameters == effect.parameters


def test_the_file_holds_the_units_of_the_rail():
    model = cart()
    again = Model.from_text(model.text())
    assert again.hash == model.hash
    assert again.quantities['viscous_friction.coefficient'].unit == 'N s/m'
    assert model.with_effect('quadratic_friction').quantities[
        'quadratic_friction.coefficient'].unit == 'N s^2/m^2'  # fmt: skip
    with pytest.raises(ModelError, match=r"coefficient.unit: 'N m s/rad' is not 'N s/m'"):
        Model.from_text(FILE.replace('N s/m', 'N m s/rad'))
    with pytest.raises(ModelError, match=r"actuators.force.limit.unit: 'N m' is not 'N'"):
        Model.from_text(FILE.replace('value: 20.0, unit: N', 'value: 20.0, unit: N m'))


def test_a_cart_that_only_rubs_comes_to_rest_exponentially():
    model = cart().without_effect('coulomb_friction')
    time = np.arange(0, 2.0, 0.01)
    states, _ = simulate(model, Setup(), time, np.zeros((len(time), 1)), np.array([0, 0, 0.5, 0]))
    # The pole follows a moment later; momentum is lost by -0.8 N s/m times the way of the cart.
    momentum = 1.5 * states[:, 2] + 0.3 * 0.4 * np.cos(states[:, 1]) * states[:, 3]
    np.testing.assert_allclose(momentum, 0.75 - 0.8 * states[:, 0], atol=1e-6)
