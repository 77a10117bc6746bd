"""A new effect is one class: all that knows models takes it, and it is found in data."""

import math

import casadi as ca
import numpy as np
import pytest

from cg_control.balancing.linearise import linearise_stance
from cg_description.paths import model_path
from cg_dynamics.effects import LIBRARY
from cg_dynamics.effects.effect import Effect, SensorEffect, StanceEffect
from cg_dynamics.model import Model
from cg_dynamics.parameter import Parameter
from cg_dynamics.rig import Setup, Spring
from cg_estimation.observer_settings import ObserverSettings, make_estimator
from cg_sysid import Options, diagnose, rehearse
from cg_sysid.checks.loading import Loaded
from cg_sysid.cli.diagnose import diagnosis_curves
from cg_sysid.provenance import provenance
from cg_sysid.report import render
from cg_sysid.report.facts import diagnosis_facts

SPRINGS = tuple(Spring('inner', 1.0, (x, 1.0), 200.0, 0.5) for x in (1.3, -1.3))
RIVAL = 'ground_slope'


def size(unit, start, scale):
    """The one parameter of a made-up effect."""
    return (
        Parameter('size', unit, 'of it', -50.0, 50.0, neutral=0.0, starts=(start,), scale=scale),
    )


class TiredDrive(Effect):
    """A command path: the harder, the less."""

    name, place = 'tired_drive', 'command'
    summary = 'The drive gives way under load: tau_motor = tau - size tau |tau|.'
    parameters = size('1/(N m)', 0.001, 0.001)

    def deliver(self, torque, z, p):
        return torque - p['size'] * torque * ca.fabs(torque), []


class SlippingBelt(Effect):
    """A transmission: the faster, the less."""

    name, place = 'slipping_belt', 'transmission'
    summary = 'The belt slips with the rate: tau_joint = tau (1 - size tanh(rate^2)).'
    parameters = size('1', 0.05, 0.01)

    def transmit(self, torque, angle, rate, z, p):
        return torque * (1 - p['size'] * ca.tanh(rate**2)), []


class HarshJoint(Effect):
    """A joint: friction with the cube of the rate."""

    name, place = 'harsh_joint', 'joint'
    summary = 'The joint resists with the cube of its rate: -size rate^3.'
    parameters = size('N m s^3/rad^3', 0.01, 0.01)

    def joint_torque(self, angle, rate, load, z, p):
        return -p['size'] * rate**3, []


class MagneticFloor(StanceEffect):
    """The environment: a foot that is pulled to certain leans."""

    name = 'magnetic_floor'
    summary = 'The foot that stands is pulled to certain leans: -size sin(9 lean).'
    parameters = size('N m', 0.1, 0.1)

    def force(self, body, z, p):
        force = ca.SX.zeros(body.q.shape)
        force[body.stance] = -p['size'] * ca.sin(9 * body.q[body.stance])
        return force, []


class BentScale(SensorEffect):
    """A sensor: an encoder whose scale is bent."""

    name, kind = 'bent_scale', 'encoder'
    summary = 'The scale of the encoder is bent: y = angle + size angle^2.'
    parameters = size('1/rad', 0.01, 0.01)

    def read(self, outputs, z, p):
        y = outputs[self.site]
        return {**outputs, self.site: y + p['size'] * y**2}, []


MADE_UP = {
    TiredDrive: 0.02, SlippingBelt: 0.4, HarshJoint: 0.15, MagneticFloor: 1.5, BentScale: 0.05,
}  # fmt: skip


@pytest.mark.slow
@pytest.mark.parametrize(
    ('effect', 'hidden'),
    [
        pytest.param(*case, marks=pytest.mark.evidence) if case[0] is MagneticFloor else case
        for case in MADE_UP.items()
    ],
    ids=lambda x: getattr(x, 'name', ''),
)
def test_a_new_effect_is_known_everywhere(effect, hidden, monkeypatch):
    monkeypatch.setitem(LIBRARY, effect.name, effect)
    nominal = Model.load(model_path('compass_gait_mit'))
    machine = nominal.with_effect(effect.name, size=hidden)
    # Simulator: it makes the records.
    records = [
        rehearse(
            f'r{k}', machine, Setup(springs=SPRINGS), [0.1 - 0.1 * k, -0.1, 0.3, -0.5],
            [lambda t, k=k: 6.0 * math.sin(2 * math.pi * (0.5 + 0.2 * k + 0.1 * t) * t)],
            4.0, 0.004, k,
        )
        for k in range(2)
    ]  # fmt: skip
    # Controllers and observer take the model as it is.
    assert np.isfinite(linearise_stance(machine, 'inner').A).all()
    observer = make_estimator(ObserverSettings(), machine, Setup(stance='inner'))
    readings = {'imu_angle': 0.01, 'imu_rate': 0.0, 'hip_angle': 0.02}
    for k in range(5):
        estimate = observer.step(1_000_000_000 + 2_000_000 * k, 0.1, readings, 'inner')
    assert np.isfinite(estimate.x).all()
    # Diagnosis finds it, with its size, and the report says its sentence.
    found = diagnose(nominal, records, Options(effects=(effect.name, RIVAL), workers=1))
    assert [cause.label for cause in found.causes] == [effect.name], found.summary
    value, sigma, _ = found.causes[0].parameters['size']
    assert abs(value - hidden) < 4 * sigma
    made = provenance(model_path('compass_gait_mit'), ['diagnose'], {}, '2011-03-13T07:00:00Z')
    facts = diagnosis_facts(found, Loaded(tuple(records), (), {}), made)
    assert effect.name in render(facts, diagnosis_curves(found))
    assert f'{effect.name}' in found.extended.model.text()
