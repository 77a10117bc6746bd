"""Pushes of other shapes than the library's pulse: found, and their intervals hold.

A hand gives a half sine, a machine a rectangle; the library's pulse starts as a bell. Impulse
and middle are what all of them have in common.
"""

import math
from types import SimpleNamespace

import casadi as ca
import numpy as np
import pytest
from hanging_arm import nominal as arm
from unlisted import SETUPS, hide

from cg_dynamics.effects.effect import TIME, StanceEffect
from cg_dynamics.model import Model
from cg_sysid.diagnosis.diagnose import diagnose
from cg_sysid.diagnosis.result import Options
from cg_sysid.experiments.excitation import ExcitationSettings, make_signal
from cg_sysid.experiments.rehearsal import rehearse
from cg_sysid.search import model_selection

SAMPLE = 0.002
DURATION = 4.0
PUSHES = {0: (3.1, 1.37), 1: (-1.9, 2.61), 2: (-2.4, 0.93), 3: (1.3, 3.11)}  # N s, s: middle
SURELY = 2.58  # standard deviations: 99 % of intervals hold


def pulse_of(shape, width, impulse, middle):
    """A force at the hip that only the machine knows.

    The machine's clock stands still between samples: the widths are whole numbers of samples.
    """

    class Pulse(StanceEffect):
        # A law without parameters is known by its name: every one its own.
        name = f'hidden_{shape}_{width}_{impulse}_{middle}'
        parameters, extra_inputs = (), (TIME,)

        def acts(self, values):
            return True

        def force(self, body, z, p):
            late = (p[TIME] - middle) / width
            if shape == 'rectangle':
                force = impulse / width
            else:
                force = math.pi / 2 * impulse / width * ca.cos(math.pi * late)
            hip, _ = body.hip()
            return ca.gradient(hip[0], body.q) * ca.if_else(ca.fabs(late) < 0.5, force, 0), []

    return Pulse


def records_of(nominal, shape, width, pushed):
    made = []
    for k in range(6):
        setup, start = SETUPS[k % len(SETUPS)]
        machine = nominal
        if k in pushed:
            machine = hide(nominal, pulse_of(shape, width, *PUSHES[k]))
        else:
            machine = machine.with_values(hide(nominal, pulse_of(shape, width, 0, 1)).values)
        settings = ExcitationSettings(
            amplitude=6.0, f_min=0.1, f_max=2.5, duration=DURATION, seed=30 + k
        )
        made.append(rehearse(f'record_{k}', machine, setup, start, [make_signal(settings)],
                             DURATION, SAMPLE, 30 + k))  # fmt: skip
    return made


@pytest.mark.parametrize(('shape', 'width'), [
    pytest.param('rectangle', 0.02, marks=pytest.mark.evidence),
    ('half_sine', 0.12),
    pytest.param('rectangle', 0.12, marks=pytest.mark.evidence),
    pytest.param('half_sine', 0.02, marks=pytest.mark.evidence),
])  # fmt: skip
def test_pushes_of_other_shapes_are_found_one_by_one(model_file, shape, width):
    nominal = Model.load(model_file)
    records = records_of(nominal, shape, width, PUSHES)
    effects = ('external_push', 'sensor_delay', 'torque_constant')
    answer = diagnose(nominal, records, Options(effects=effects, workers=1))
    assert answer.verdict == 'explained', answer.summary
    (cause,) = answer.causes
    assert cause.label == 'external_push'
    assert set(cause.events) == {f'record_{k}' for k in PUSHES}
    off = []
    for k, (impulse, middle) in PUSHES.items():
        if shape == 'half_sine':  # as the machine's clock stands still between samples
            rows = (np.arange(-width / 2, width / 2 - 1e-9, SAMPLE) + SAMPLE / 2) / width
            impulse *= math.pi / 2 * np.cos(math.pi * rows).mean()
        found = cause.events[f'record_{k}']
        for (value, sigma, _), truth in zip(
            (found['impulse'], found['instant']), (impulse, middle), strict=True
        ):
            off.append((value - truth) / sigma)
    # Eight intervals; that two of them miss 99 % has a probability of 0.3 %.
    assert np.sum(np.abs(off) > SURELY) <= 1, off
    # And they are no wider than they need be.
    assert np.median(np.abs(off)) > 0.1, off


@pytest.mark.evidence
def test_a_push_in_a_record_held_out_and_in_no_other(model_file):
    """Beside a cause that explains all the others."""
    nominal = Model.load(model_file)
    impulse, middle = 2.7, 1.81
    pushed = hide(nominal, pulse_of('half_sine', 0.12, impulse, middle))
    records = []
    for k in range(6):
        machine = pushed if k == 3 else nominal.with_values(pushed.values)
        machine = machine.with_effect('torque_dead_zone', half_width=0.7)
        setup, start = SETUPS[k % len(SETUPS)]
        settings = ExcitationSettings(
            amplitude=6.0, f_min=0.1, f_max=2.5, duration=DURATION, seed=60 + k
        )
        records.append(rehearse(f'record_{k}', machine, setup, start, [make_signal(settings)],
                                DURATION, SAMPLE, 60 + k))  # fmt: skip
    effects = ('external_push', 'torque_dead_zone', 'encoder_zero', 'torque_constant')
    answer = diagnose(nominal, records, Options(effects=effects, workers=1))
    assert 'record_3' in {data_set.name for data_set in answer.held}
    found = {cause.label: cause for cause in answer.causes}
    assert set(found) == {'external_push', 'torque_dead_zone'}, answer.summary
    ((name, event),) = found['external_push'].events.items()
    assert name == 'record_3'
    value, sigma, _ = event['impulse']
    assert value == pytest.approx(impulse, abs=max(3 * sigma, 0.01 * impulse))


@pytest.mark.parametrize(('thigh', 'shank', 'told'), [
    # Dry friction of the arm: 0.15 N m at the thigh, 0.1 at the shank. A pulse of 0.1 s is
    # 0.346 s long; at 2 % of the friction it has 1.04 and 0.69 mN m s.
    (0.9e-3, 0.5e-3, '2 % of the dry friction at thigh_joint'),
    (0.6e-3, -0.6e-3, '2 % of the dry friction at shank_joint'),
    (1.2e-3, 0.5e-3, ''),
    (0.5e-3, -0.8e-3, ''),
    # What is not sure says nothing: its standard deviation is 0.1 mN m s.
    (0.9e-3, 0.4e-3, '2 % of the dry friction at thigh_joint'),
])  # fmt: skip
def test_what_friction_may_be_off_is_no_push(monkeypatch, thigh, shank, told):
    model = arm().with_effect('external_push', 'shank', duration=0.1)
    o = SimpleNamespace(label='external_push@shank', model=model)
    event = {
        'impulse_shank_joint': (shank, 1e-4, 'N m s'),
        'impulse_thigh_joint': (thigh, 1e-4, 'N m s'),
        'impulse_hip_joint': (3e-4, 1e-4, 'N m s'),
        'instant': (2.0, 0.01, 's'),
    }
    monkeypatch.setattr(model_selection, 'events_of', lambda o, label: {'way': event})
    reason = ' '.join(model_selection.within_friction(o))
    assert reason.startswith(told)
    assert bool(reason) == bool(told)
    # A joint without dry friction has nothing that could be off.
    o.model = model.without_effect('coulomb_friction@thigh_joint')
    assert not model_selection.within_friction(o)


def test_a_push_of_a_compass_gait_is_not_compared_with_friction(model_file, monkeypatch):
    model = Model.load(model_file).with_effect('external_push', impulse=1e-6)
    o = SimpleNamespace(label='external_push', model=model)
    event = {'impulse': (1e-6, 1e-9, 'N s'), 'instant': (1.0, 0.01, 's')}
    monkeypatch.setattr(model_selection, 'events_of', lambda o, label: {'swing': event})
    assert not model_selection.within_friction(o)


def test_what_surely_happened_in_no_record_is_no_push(monkeypatch):
    """A sum of little in every record may be many nats; no one of them says that it was pushed."""
    model = arm().with_effect('external_push', 'shank').with_effect('payload', 'shank')
    sure = {'impulse_shank_joint': (0.3, 0.01, 'N m s')}
    for label, events, told in (
        ('external_push@shank', {}, True),
        ('external_push@shank', {'way': sure}, False),
        ('payload@shank', {}, False),  # a property of the machine: no event
        ('small faults', {}, False),
    ):
        o = SimpleNamespace(label=label, model=model)
        monkeypatch.setattr(model_selection, 'events_of', lambda o, label, e=events: e)
        assert bool(model_selection.never_happens(o)) == told, (label, events)
