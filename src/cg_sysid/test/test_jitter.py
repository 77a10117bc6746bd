"""Hidden jitter: regular stamps, irregular sampling, told from the samples alone."""

from dataclasses import replace

import numpy as np
import pytest
from unlisted import SETUPS

from cg_dynamics.model import Model
from cg_dynamics.rig import Setup
from cg_interfaces.channels import mechanism
from cg_sysid.checks.recordings import check_recording
from cg_sysid.diagnosis.diagnose import diagnose
from cg_sysid.diagnosis.late_samples import late_samples
from cg_sysid.diagnosis.result import Options
from cg_sysid.experiments.excitation import ExcitationSettings, make_signal
from cg_sysid.experiments.rehearsal import rehearse
from cg_sysid.experiments.synthetic import Synthesis, synthesise
from cg_sysid.identification.data_set import DataSet

SIGMA = 4e-4  # s RMS
RATE = 500.0
SEEDS = [0, *(pytest.param(seed, marks=pytest.mark.evidence) for seed in range(1, 6))]

SENSORS = {
    'encoders': {'quantum': 2 * np.pi / 8192},
    'coarse encoders': {'quantum': 2 * np.pi / 1024},
    'noise': {'quantum': 0.0, 'noise': 3e-4},
}
BODIES = {
    'double pendulum': {'mechanism': 'double_pendulum', 'amplitude': 1.0},
    'pendulum': {'mechanism': 'pendulum', 'amplitude': 1.5},
    'robot': {'amplitude': 0.3},
}


def recording(seed, sigma=0.0, **options):
    """Sampled at instants that are off by `sigma`, stamped as if they were not."""
    raw = synthesise(Synthesis(jitter=sigma * RATE * np.sqrt(12.0), **options), seed)
    first = next(iter(raw.topics.values())).stamp_ns[0]
    topics = {
        name: replace(t, stamp_ns=first + np.rint(np.arange(len(t)) * 1e9 / RATE).astype(np.int64))
        for name, t in raw.topics.items()
    }
    return replace(raw, topics=topics)


@pytest.mark.parametrize('seed', SEEDS)
@pytest.mark.parametrize('sensor', SENSORS)
@pytest.mark.parametrize('body', BODIES)
def test_hidden_jitter_is_told_with_its_size_and_refuses_nothing(body, sensor, seed):
    raw = recording(seed, SIGMA, **BODIES[body], **SENSORS[sensor])
    report = check_recording(raw)
    found = report.of('jitter')
    assert found
    assert {f.severity for f in found} == {'warning'}
    # Uniform jitter in the medians of some thousand squares, rounding beside it: a fifth.
    assert found[0].value == pytest.approx(SIGMA, rel=0.2)
    assert report.verdict == 'warnings', [f.text for f in report.findings]


@pytest.mark.parametrize('seed', SEEDS)
@pytest.mark.parametrize('sensor', SENSORS)
@pytest.mark.parametrize('body', BODIES)
def test_regular_sampling_and_honest_stamps_are_no_jitter(body, sensor, seed):
    options = {**BODIES[body], **SENSORS[sensor]}
    assert not check_recording(recording(seed, **options)).of('jitter')
    honest = synthesise(Synthesis(jitter=0.7, **options), seed)
    assert not check_recording(honest).of('jitter')


def test_noise_that_does_not_know_of_the_rate_is_no_jitter():
    assert not check_recording(recording(3, noise=2e-3, quantum=0.0)).of('jitter')


def data_set(raw, name):
    """A recording as two windows of a data set."""
    known = raw.mechanism
    topic = raw.topics[known.outputs[0].name]
    time = (topic.stamp_ns - topic.stamp_ns[0]) / 1e9
    outputs = np.column_stack([topic.values[n] for n in known.output_names])
    half = len(time) // 2
    return [
        DataSet(f'{name}_{k}', name, time[part] - time[part][0], np.zeros((half, 2)),
              known.input_names, outputs[part], np.ones(2), Setup(), np.zeros(4), np.ones(4),
              since=float(time[part][0]))
        for k, part in enumerate((slice(0, half), slice(half, 2 * half)))
    ]  # fmt: skip


def said(sigma):
    options = {**BODIES['double pendulum'], **SENSORS['noise']}
    data_sets = [t for s in (1, 2) for t in data_set(recording(s, sigma, **options), f'r{s}')]
    outputs = mechanism('double_pendulum').output_names
    return late_samples(data_sets, mechanism('double_pendulum'), outputs, outputs[1], 'rad')


def test_an_unexplained_error_is_told_what_timing_makes_of_it():
    assert 'by 0.41 ms RMS' in said(SIGMA)
    assert 'of error in elbow_angle' in said(SIGMA)
    assert said(0.0) == ''


def test_a_small_error_of_timing_is_no_consistency(model_file):
    """Less than twice the noise, which other errors are forgiven."""
    nominal, records = Model.load(model_file), []
    for k in range(4):
        setup, start = SETUPS[k % len(SETUPS)]
        settings = ExcitationSettings(
            amplitude=6.0, f_min=0.1, f_max=2.5, duration=6.0, seed=80 + k
        )
        signal, rng = make_signal(settings), np.random.default_rng(80 + k)
        record = rehearse(f'record_{k}', nominal, setup, start, [signal], 6.0, 1 / RATE, 80 + k)
        off = rng.normal(0.0, SIGMA, len(record.stamp_ns))
        # To first order a sample that is late by `off` is rate times off further.
        records.append(replace(record, outputs={
            name: values + off * np.gradient(_smooth(values), 1 / RATE)
            for name, values in record.outputs.items()
        }))  # fmt: skip
    options = Options(effects=('torque_constant', 'imu_offset'), workers=1)
    answer = diagnose(nominal, records, options)
    assert (answer.verdict, answer.causes) == ('unexplained', ())
    assert 'beside their stamps, by 0.' in answer.summary


def _smooth(values):
    return np.convolve(np.pad(values, 4, mode='edge'), np.ones(9) / 9, mode='valid')
