"""Hide an effect in a machine, record it, and require that the diagnosis finds it.

The analysis gets bags in the recorder's format and a nominal model whose numbers are 10 to 20 %
off, nothing else. The machine is integrated 20 times finer than the fit integrates. The live way
through the topics is in test_demo.py, the wide table over magnitudes and seeds in
bench/hidden_effects.py, and machines simulated by MuJoCo in cg_sysid.
"""

import json

import numpy as np
import pytest

from cg_bringup.hidden import hide, perturb
from cg_description.paths import NOMINAL_MODEL, model_path
from cg_dynamics.model import Model
from cg_sysid.cli.diagnose import main
from cg_sysid.diagnosis.diagnose import diagnose
from cg_sysid.diagnosis.result import Options
from cg_sysid.experiments.catalogue import load_experiment
from cg_sysid.experiments.excitation import ExcitationSettings, make_signal
from cg_sysid.experiments.rehearsal import rehearse
from cg_sysid.records.bag_writer import write_bag
from cg_sysid.records.bags import read_bag

PROGRAMME = (
    'spring_stabilised_inner',
    'spring_stabilised_outer',
    'swing_inner_fixed',
    'swing_outer_fixed',
) * 2
SPRINGS = ('spring_stabilised_inner', 'spring_stabilised_outer') * 2
SWINGS = ('swing_inner_fixed', 'swing_outer_fixed') * 2
DURATION = 6.0  # s
SHORT = 4.0  # s, enough for what acts all the time

# Effect and seed, what comes nearest to it (where it is not given, the whole library is tried),
# and what is recorded: what is wrong at the hip shows where a leg swings, and that is quickly
# simulated. Others are hidden in MuJoCo's robot in cg_sysid, all in the benches.
FRICTIONS = (
    'coulomb_friction', 'viscous_friction', 'quadratic_friction', 'asymmetric_friction',
    'load_dependent_friction', 'presliding_friction',
)  # fmt: skip
HIDDEN = (
    pytest.param('actuator_lag', 12, None, SWINGS[::2], SHORT, marks=pytest.mark.evidence),
    pytest.param(
        'stribeck_friction', 17, ('stribeck_friction', *FRICTIONS), SWINGS, DURATION,
        marks=pytest.mark.evidence,
    ),
    (
        'backlash', 20,
        ('backlash', 'joint_flexibility', 'actuator_delay', 'encoder_eccentricity'), SWINGS, SHORT,
    ),
    *(
        pytest.param(effect, seed, None, PROGRAMME, DURATION, marks=pytest.mark.evidence)
        for effect, seed in (
            ('stribeck_friction', 17), ('backlash', 20), ('coulomb_friction', 15),
            ('encoder_offset', 23), ('imu_offset', 24),
        )
    ),
)  # fmt: skip


def recorded(machine, seed, directory, programme=PROGRAMME, duration=DURATION):
    """Records of the programme on a machine, through bags on disk."""
    records = []
    for index, name in enumerate(programme):
        experiment = load_experiment(name)
        settings = ExcitationSettings(
            **experiment.excitation, duration=duration, seed=100 * seed + index
        )
        record = rehearse(
            f'{index}_{name}',
            machine,
            experiment.setup,
            experiment.initial_state,
            [make_signal(settings)],
            duration,
            seed=1000 * seed + index,
        )
        records.append(read_bag(write_bag(directory / record.name, record)))
    return records


@pytest.mark.slow
@pytest.mark.parametrize(('effect', 'seed', 'candidates', 'programme', 'duration'), HIDDEN)
def test_a_hidden_effect_is_named_and_its_gain_measured(
    effect, seed, candidates, programme, duration, tmp_path
):
    hidden = hide(Model.load(model_path(NOMINAL_MODEL)), effect, seed)
    records = recorded(hidden.model, seed, tmp_path, programme, duration)
    found = diagnose(hidden.nominal, records, Options(effects=candidates, workers=1))

    named = {cause.label.partition('@')[0] for cause in found.causes}
    rivals = {rival.partition('@')[0] for cause in found.causes for rival in cause.rivals}
    assert named | rivals == {effect}, found.summary
    assert found.verdict == 'explained'

    # With the cause in it the model simulates unseen records to within 20 % of the noise floor.
    before = found.baseline.held.normalised_error
    after = found.extended.held.normalised_error
    assert after < 1.2**2 < before
    first = next(iter(hidden.values))
    value, sigma, _ = found.causes[0].parameters[first]
    # Four standard deviations, and a part in a hundred for what no model does better.
    assert abs(value - hidden.values[first]) < 4 * sigma + 0.01 * abs(hidden.values[first])


@pytest.mark.parametrize(
    'seed', [1, *(pytest.param(seed, marks=pytest.mark.evidence) for seed in (2, 3))]
)
def test_nothing_hidden_is_consistent(seed, tmp_path):
    nominal = Model.load(model_path(NOMINAL_MODEL))
    machine, _ = perturb(nominal, np.random.default_rng(seed))
    records = recorded(machine, seed, tmp_path, duration=SHORT)
    found = diagnose(nominal, records, Options(workers=1))
    assert found.verdict == 'consistent', found.summary
    assert not found.causes


@pytest.mark.parametrize(
    ('effect', 'programme', 'duration'),
    [
        pytest.param('external_push', SPRINGS, DURATION, marks=pytest.mark.evidence),
        ('friction_drift', SWINGS, SHORT),
        pytest.param('imu_drift', SWINGS, SHORT, marks=pytest.mark.evidence),
        pytest.param('tether_force', SPRINGS, SHORT, marks=pytest.mark.evidence),
    ],
)
def test_the_command_line_tells_of_every_kind_of_effect(effect, programme, duration, tmp_path):
    """Values of a record's own, laws of the time, ties with small faults: up to the report."""
    hidden = hide(Model.load(model_path(NOMINAL_MODEL)), effect, 61)
    records = recorded(hidden.model, 61, tmp_path, programme, duration)
    bags = [str(tmp_path / record.name) for record in records]
    nominal, out = tmp_path / 'nominal.yaml', tmp_path / 'answer'
    hidden.nominal.save(nominal)
    words = ['--model', str(nominal), '--out', str(out), '--workers', '1', '--effects', effect]
    assert main([*words, *bags]) == 0
    facts = json.loads((out / 'diagnosis.json').read_text(encoding='utf-8'))
    assert [cause['label'] for cause in facts['causes']] == [effect]
    assert bool(facts['causes'][0]['rivals']) == (effect == 'tether_force')
    assert (out / 'report.html').stat().st_size > 10_000


@pytest.mark.evidence
def test_small_faults_that_came_first_hide_no_second_effect(tmp_path):
    """Soft springs and a tilted sensor imitate a round foot, but for the last of it."""
    nominal = Model.load(model_path(NOMINAL_MODEL))
    hidden = {'imu_lag': {'time_constant': 0.0074}, 'foot_radius': {'radius': 0.0388}}
    machine, _ = perturb(nominal, np.random.default_rng(2103))
    for name, values in hidden.items():
        machine = machine.with_effect(name, None, **values)
    options = Options(effects=(*hidden, 'torque_bias', 'quadratic_friction'), workers=1)
    found = diagnose(nominal, recorded(machine, 2103, tmp_path, SPRINGS, SHORT), options)
    assert {cause.label for cause in found.causes} == set(hidden), found.summary
    assert found.extended.held.normalised_error < 1.1  # noise, within a few per cent
