"""A mechanism with a joint that slides: a cart on a rail, a pole hanging from it."""

import casadi as ca

from cg_dynamics.mechanisms import MECHANISMS, Mechanism
from cg_dynamics.model import Model
from cg_dynamics.parameter import Parameter


class CartPole(Mechanism):
    """A motor drives the cart along the rail, and none the pole."""

    name = 'cart_pole'
    coordinates = ('cart', 'pole')
    sliding = ('cart',)
    joints = {'rail': (1.0, 0.0)}  # noqa: RUF012 - read only
    inputs = ('force',)
    outputs = ('position', 'angle')
    output_units = ('m', 'rad')
    sensor_kinds = {'position': 'encoder', 'angle': 'encoder'}  # noqa: RUF012 - read only
    bodies = ('pole',)
    parameters = (
        Parameter('cart_mass', 'kg', 'of the cart', 1e-3, 1e3, scale=0.05),
        Parameter('pole_mass', 'kg', 'a point at its end', 1e-3, 1e3, scale=0.05),
        Parameter('pole_length', 'm', 'of the pole', 1e-2, 10.0, free=False),
        Parameter('gravity', 'm/s^2', 'acceleration of gravity', 0.0, 30.0, free=False),
    )

    def energies(self, q, v, p, setup, up, foot=None):
        """Of the cart and of the point at the end of the pole."""
        end = self.point('pole', p['pole_length'], q, p, setup)
        speed = ca.jtimes(end, q, v)
        kinetic = (p['cart_mass'] * v[0] ** 2 + p['pole_mass'] * ca.sumsqr(speed)) / 2
        return kinetic, p['pole_mass'] * p['gravity'] * ca.dot(up, end)

    def point(self, body, distance, q, p, setup):
        """A point of the pole, `distance` m below the cart."""
        return ca.vertcat(q[0] + distance * ca.sin(q[1]), -distance * ca.cos(q[1]))

    def sensors(self, q, v):
        """An encoder each."""
        return {'position': q[0], 'angle': q[1]}


FILE = """\
format: cg_model/1
name: cart
mechanism: cart_pole
parameters:
  cart_mass: {value: 1.2, unit: kg}
  pole_mass: {value: 0.3, unit: kg}
  pole_length: {value: 0.4, unit: m, fixed: true}
  gravity: {value: 9.81, unit: m/s^2, fixed: true}
effects:
- name: viscous_friction
  parameters:
    coefficient: {value: 0.8, unit: N s/m}
- name: coulomb_friction
  parameters:
    torque: {value: 0.5, unit: N}
    transition_rate: {value: 0.01, unit: m/s}
sensors:
  position: {noise: {value: 1.0e-4, unit: m}}
  angle: {noise: {value: 1.0e-3, unit: rad}}
actuators:
  force: {limit: {value: 20.0, unit: N}}
"""


def install(monkeypatch) -> None:
    """Make the mechanism one that model files may name."""
    monkeypatch.setitem(MECHANISMS, 'cart_pole', CartPole())


def cart() -> Model:
    """The cart as its file has it; `install` comes first."""
    return Model.from_text(FILE)
