"""Where recordings cannot tell causes apart, the next experiment is named, and it does."""

import pytest

from cg_dynamics.model import Model
from cg_sysid.diagnosis.diagnose import diagnose
from cg_sysid.diagnosis.experiment_design import imagined
from cg_sysid.diagnosis.result import Options
from cg_sysid.experiments.catalogue import experiments_for, load_experiment
from cg_sysid.experiments.excitation import ExcitationSettings, make_signal
from cg_sysid.experiments.rehearsal import rehearse
from cg_sysid.identification.data_set import prepare
from cg_sysid.search import settings

EFFECTS = ('ankle_friction', 'spring_damping', 'aerodynamic_drag', 'torque_bias')


def _record(machine, name, seed, duration, excitation=None):
    experiment = load_experiment(name)
    settings = ExcitationSettings(
        **(excitation or experiment.excitation), duration=duration, seed=seed
    )
    return rehearse(
        f'{name}_{seed}', machine, experiment.setup, experiment.initial_state,
        [make_signal(settings)], duration, seed=seed,
    )  # fmt: skip


@pytest.mark.slow
def test_the_proposed_experiment_settles_what_is_ambiguous(model_file):
    nominal = Model.load(model_file)
    machine = nominal.with_values({'c1': 1.1 * nominal.values['c1']})
    machine = machine.with_effect('ankle_friction', coefficient=0.8)
    records = [_record(machine, 'spring_stabilised_inner', seed, 4.0) for seed in (1, 2)]
    options = Options(effects=EFFECTS, workers=1, experiments=tuple(experiments_for(nominal)))
    first = diagnose(nominal, records, options)
    assert first.verdict == 'ambiguous'
    (cause,) = first.causes
    assert {cause.label, *cause.rivals} == {'ankle_friction', 'spring_damping'}
    best = cause.proposals[0]
    assert best.evidence > settings.SELECTION.margin
    assert best.experiment != 'spring_stabilised_inner'
    assert best.experiment in first.summary
    records += [
        _record(machine, best.experiment, seed, best.duration, best.excitation)
        for seed in (3, 4)
    ]  # fmt: skip
    second = diagnose(nominal, records, options)
    assert second.verdict == 'explained'
    assert [c.label for c in second.causes] == ['ankle_friction']
    # The rival loses at least what was promised for one record, whichever of the two was true.
    nats = {c.label: c.evidence for c in second.rounds[0].candidates}
    assert nats['ankle_friction'] - nats['spring_damping'] > best.evidence


def test_causes_that_are_one_get_no_advice(model_file):
    """Late torques and late readings: no torque that can be launched tells them apart."""
    nominal = Model.load(model_file)
    machine = nominal.with_values({'c1': 1.1 * nominal.values['c1']})
    machine = machine.with_effect('actuator_delay', delay=0.008)
    records = [
        _record(machine, name, seed, 5.0)
        for seed, name in enumerate(2 * ('spring_stabilised_inner', 'swing_inner_fixed'))
    ]
    options = Options(effects=('actuator_delay', 'sensor_delay'), workers=1,
                      experiments=tuple(experiments_for(nominal)))  # fmt: skip
    found = diagnose(nominal, records, options)
    assert found.verdict == 'ambiguous'
    (cause,) = found.causes
    assert {cause.label, *cause.rivals} == {'actuator_delay', 'sensor_delay'}
    # Both are fitted to the same noise: what is left is how deep the fits went.
    assert all(abs(p.evidence) < 0.1 * settings.SELECTION.margin for p in cause.proposals)
    assert 'No experiment that can be launched would tell' in found.summary


def test_imagined_record_is_what_the_machine_would_record(model_file):
    # The compiled rollout of the rehearsal beside the plant, which shares the model only.
    nominal = Model.load(model_file)
    experiment = load_experiment('swing_inner_fixed')
    record = _record(nominal, 'swing_inner_fixed', 20111, 5.0)
    (data_set,) = prepare(nominal, [record])
    seen = imagined(nominal, data_set.sigma, experiment, experiment.excitation)
    difference = (seen.outputs - data_set.outputs)[100:] / data_set.sigma
    # Two draws of noise: the difference has a standard deviation of sqrt(2).
    assert difference.std() == pytest.approx(2**0.5, rel=0.1)
