"""Effects whose error has many local minima: a frequency, an instant."""

import math

import pytest

from cg_dynamics.model import Model
from cg_dynamics.rig import Setup, Spring
from cg_sysid.candidates import Task, try_candidate
from cg_sysid.rehearse import rehearse
from cg_sysid.trial import prepare

SPRINGS = tuple(Spring('inner', 1.0, (x, 1.0), 200.0, 0.5) for x in (1.3, -1.3))


@pytest.mark.parametrize(
    ('effect', 'values'),
    [
        ('external_push', {'impulse': 1.5, 'instant': 2.8, 'duration': 0.1}),
        ('cogging_torque', {'amplitude': 0.6, 'cycles': 31.5, 'phase': 0.8}),
    ],
)
def test_found_from_its_grid_of_starts(model_file, effect, values):
    nominal = Model.load(model_file)
    off = {'c1': 1.06 * nominal.values['c1'], 'c5': 0.92 * nominal.values['c5']}
    machine = nominal.with_values(off).with_effect(effect, **values)
    records = [
        rehearse(
            f'record_{k}', machine, Setup(springs=SPRINGS), [0.1 - 0.2 * k, -0.1, 0.3, -0.5],
            [lambda t, k=k: 9.0 * math.sin(2 * math.pi * (0.5 + 0.2 * k + 0.15 * t) * t)],
            4.0, 0.004, k,
        )
        for k in range(2)
    ]  # fmt: skip
    train, held = prepare(nominal, records)
    outcome = try_candidate(Task(nominal, (effect, None)), [train], [held])
    # Noise alone gives 1, within a few percent at a thousand rows.
    assert outcome.held.normalised_error < 1.2
    found = {name: outcome.train.model.values[f'{effect}.{name}'] for name in values}
    if 'phase' in found and found['amplitude'] < 0:
        # A sin(x) and -A sin(x + pi) are the same wave.
        found['amplitude'], found['phase'] = -found['amplitude'], found['phase'] + math.pi
    for name, value in values.items():
        if name == 'phase':
            found[name] = value + math.remainder(found[name] - value, 2 * math.pi)
        assert found[name] == pytest.approx(value, rel=0.02)
