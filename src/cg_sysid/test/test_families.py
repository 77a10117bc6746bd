"""Laws of another shape than the library's: named as the effect that they are a shape of."""

import math

import casadi as ca
import pytest
from unlisted import DetentTorque, ViscoelasticHip, hide, records

from cg_dynamics.effects import LIBRARY
from cg_dynamics.effects.effect import TIME
from cg_dynamics.effects.unmodelled import UNMODELLED
from cg_dynamics.model import Model
from cg_sysid.diagnosis.diagnose import diagnose
from cg_sysid.diagnosis.result import Options

CYCLES, PHASE = 18.23, 0.82


class Triangle(DetentTorque):
    """Cogging that rises and falls in straight lines."""

    name = 'hidden_triangle'

    def joint_torque(self, angle, rate, load, z, p):
        return 0.8 * 2 / math.pi * ca.asin(ca.sin(CYCLES * angle + PHASE)), []


class TenTightPlaces(DetentTorque):
    """A bearing with ten tight places in a turn."""

    name = 'hidden_tight_places'

    def joint_torque(self, angle, rate, load, z, p):
        return -0.8 * (1 + ca.cos(10 * angle - 1.7)) / 2 * ca.tanh(rate / 0.01), []


class ElevenTightPlaces(DetentTorque):
    """Eleven, which no start of the library is: what data drew leads there."""

    name = 'hidden_eleven'

    def joint_torque(self, angle, rate, load, z, p):
        return -0.7 * (1 + ca.cos(11 * angle + 1.0)) / 2 * ca.tanh(rate / 0.01), []


class StraightDrift(DetentTorque):
    """Friction that falls in a straight line, by half over six seconds."""

    name, extra_inputs = 'hidden_straight_drift', (TIME,)

    def joint_torque(self, angle, rate, load, z, p):
        return -1.4 * (1 - p[TIME] / 12) * ca.tanh(rate / 0.01), []


class DeadZone(DetentTorque):
    """A drive that does not deliver the first half newton metre."""

    name, place = 'hidden_dead_zone', 'command'

    def joint_torque(self, angle, rate, load, z, p):
        return ca.SX(0), []

    def deliver(self, torque, z, p):
        return torque - ca.fmin(ca.fmax(torque, -0.5), 0.5), []


class FewBits(DeadZone):
    """A drive that rounds its command."""

    name = 'hidden_few_bits'

    def deliver(self, torque, z, p):
        return 0.83 * ca.floor(torque / 0.83 + 0.5), []


@pytest.fixture(scope='module')
def nominal(model_file):
    return Model.load(model_file)


@pytest.mark.slow
@pytest.mark.parametrize(
    ('hidden', 'name', 'listed'),
    [
        (TenTightPlaces, 'position_dependent_friction', ('asymmetric_friction',)),
        *(pytest.param(*case, marks=pytest.mark.evidence) for case in (
            (DeadZone, 'torque_dead_zone', ('torque_saturation', 'load_dependent_friction')),
            (ViscoelasticHip, 'joint_creep', ('presliding_friction', 'torque_constant')),
            (Triangle, 'cogging_torque', ('torque_bias',)),
            (ElevenTightPlaces, 'position_dependent_friction', ('torque_bias', 'cogging_torque')),
            (StraightDrift, 'friction_drift', ('stribeck_friction',)),
            (FewBits, 'torque_quantisation', ('torque_constant', 'torque_dead_zone')),
        )),
    ],
)  # fmt: skip
def test_a_law_of_another_shape_is_named(nominal, hidden, name, listed):
    made = records(hide(nominal, hidden))
    answer = diagnose(nominal, made, Options(effects=(name, *listed), workers=1))
    assert answer.verdict == 'explained', answer.summary
    assert answer.causes[0].label == name
    parameters = answer.causes[0].parameters
    if hidden is Triangle:
        # The first wave of a triangle has 8/pi^2 of its height; its third is described.
        assert parameters['cycles'][0] == pytest.approx(CYCLES, rel=0.01)
        assert parameters['amplitude'][0] == pytest.approx(0.8 * 8 / math.pi**2, rel=0.05)
    sizes = {DeadZone: {'half_width': 0.5}, FewBits: {'step': 0.83},
             ViscoelasticHip: {'stiffness': 8.0, 'time_constant': 0.3}}  # fmt: skip
    for parameter, value in sizes.get(hidden, {}).items():
        # Edges that are round in the law and sharp in the machine take the rest.
        assert parameters[parameter][0] == pytest.approx(value, rel=0.03)
    if hidden in (TenTightPlaces, ElevenTightPlaces):
        count = 10 if hidden is TenTightPlaces else 11
        assert parameters['cycles'][0] == pytest.approx(count, rel=0.01)
        assert answer.extended.held.normalised_error < 1.05


def test_families_are_those_of_learned_terms():
    known = {kind.family for kind in UNMODELLED.values()}
    assert {kind.family for kind in LIBRARY.values() if kind.family} <= known
