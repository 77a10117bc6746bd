"""Checks of recordings of the simulated robot: each fault is named where it was put, none where
there is none, whatever physics is hidden in the machine. Rates over many: bench/check_rates.py.
"""

from dataclasses import replace

import numpy as np
import pytest

from cg_description.paths import model_path
from cg_dynamics.model import Model
from cg_dynamics.rig import Setup
from cg_sysid.checks.loading import load_bags
from cg_sysid.checks.recordings import check_recording
from cg_sysid.experiments import fault_injection as fault_injection
from cg_sysid.experiments.catalogue import load_experiment
from cg_sysid.experiments.excitation import ExcitationSettings, make_signal
from cg_sysid.experiments.rehearsal import rehearse
from cg_sysid.experiments.synthetic import Synthesis, synthesise
from cg_sysid.records.bags import read_bag, to_record, write_bag
from cg_sysid.report.facts import unusable_facts
from cg_sysid.report.page import render

MODEL = model_path('compass_gait_mit')
SET_UPS = (
    'spring_stabilised_inner',
    'spring_stabilised_outer',
    'swing_inner_fixed',
    'swing_outer_fixed',
)
SECONDS = 6.0
AT = 3.217  # s, where faults set in
NEAR = 0.2  # s by which a place may be off: averages of check_dynamics.py are this long
TOPICS = ('/applied_torque', '/imu', '/hip_encoder', fault_injection.ALL)


def machine_of(effect='', **values):
    """The robot with numbers 10 % off, and an effect that nobody told."""
    nominal = Model.load(MODEL)
    factors = {'c1': 1.1, 'c2': 0.9, 'c4': 0.9, 'c5': 0.92, 'viscous_friction.coefficient': 1.15}
    model = nominal.with_values({n: nominal.values[n] * f for n, f in factors.items()})
    return model.with_effect(effect, None, **values) if effect else model


def record_of(machine, name, seed):
    e = load_experiment(name)
    signal = make_signal(ExcitationSettings(**e.excitation, duration=SECONDS, seed=seed))
    return rehearse(name, machine, e.setup, e.initial_state, [signal], SECONDS, seed=seed)


@pytest.fixture(scope='module')
def sound():
    """Set-up -> a sound recording."""
    machine = machine_of()
    return {
        name: fault_injection.as_recorded(record_of(machine, name, seed), seed)
        for seed, name in enumerate(SET_UPS)
    }


def findings(raw, code, arrivals=True):
    report = check_recording(raw if arrivals else fault_injection.without_arrivals(raw), MODEL)
    return report, report.of(code)


HIDDEN = {
    'backlash': {'gap': 0.03, 'rotor_inertia': 0.1},
    'torque_saturation': {'limit': 7.0},
    'sensor_delay': {'delay': 0.02},
    'cogging_torque': {'amplitude': 1.2, 'cycles': 40.0, 'phase': 1.0},
    'external_push': {'impulse': 4.0, 'instant': 3.0, 'duration': 0.05},
    'encoder_scale': {'error': -0.06},
    'encoder_eccentricity': {'amplitude': 0.03, 'phase': 1.0},
    'joint_flexibility': {'stiffness': 150.0, 'rotor_inertia': 0.2, 'damping': 0.3},
    'imu_mount_flexibility': {'compliance': 1e-3, 'frequency': 40.0, 'damping_ratio': 0.03},
    'gyro_scale': {'error': 0.1},
    'friction_drift': {'excess': 1.5, 'time_constant': 2.0},
    'actuator_lag': {'time_constant': 0.04},
}


ALWAYS = '', 'sensor_delay', 'external_push', 'joint_flexibility', 'friction_drift'


@pytest.mark.parametrize('effect', [
    effect if effect in ALWAYS else pytest.param(effect, marks=pytest.mark.evidence)
    for effect in ('', *HIDDEN)
])  # fmt: skip
def test_physics_is_no_fault(effect):
    machine = machine_of(effect, **HIDDEN.get(effect, {}))
    for seed, name in ((20, 'spring_stabilised_inner'), (21, 'swing_outer_fixed')):
        report = check_recording(
            fault_injection.as_recorded(record_of(machine, name, seed), seed), MODEL
        )
        assert report.verdict != 'unusable', (name, report.findings[0])


@pytest.mark.parametrize('set_up', SET_UPS)
@pytest.mark.parametrize(
    ('channel', 'size'),
    [
        ('hip_angle', 0.005),
        ('imu_angle', 0.005),
        ('imu_rate', 0.02),
        ('hip_torque', 1.0),
        ('hip_angle', -0.1),
        ('imu_angle', -0.1),
        ('imu_rate', -0.2),
        ('hip_torque', -5.0),
    ],
)
def test_a_zero_that_moves_is_found(sound, set_up, channel, size):
    report, found = findings(
        fault_injection.shifted(channel, size, AT)(sound[set_up]), 'zero_shift'
    )
    assert report.verdict == 'unusable'
    assert found[0].where == channel
    assert found[0].start_s == pytest.approx(AT, abs=NEAR)
    assert found[0].value == pytest.approx(size, rel=0.25)


# With the inner legs fixed the IMU is at rest.
MOVING = [
    (set_up, channel)
    for set_up in SET_UPS
    for channel in ('hip_angle', 'imu_angle', 'imu_rate', 'hip_torque')
    if not (set_up == 'swing_inner_fixed' and channel.startswith('imu'))
]
# Signs that go together and that nothing tells from the rest: with one free angle the mirror
# image of angle and torque is the same motion.
OPEN = {
    ('swing_inner_fixed', 'hip_angle'): {'hip_angle', 'hip_torque'},
    ('swing_inner_fixed', 'hip_torque'): {'hip_angle', 'hip_torque'},
}


@pytest.mark.parametrize(('set_up', 'channel'), MOVING)
def test_a_wrong_sign_is_found(sound, set_up, channel):
    report, found = findings(fault_injection.mirrored((channel,))(sound[set_up]), 'sign_error')
    assert report.verdict == 'unusable'
    assert {f.where for f in found} == OPEN.get((set_up, channel), {channel})
    report, found = findings(fault_injection.mirrored((channel,), AT)(sound[set_up]), 'sign_error')
    assert report.verdict == 'unusable'
    assert found[0].start_s == pytest.approx(AT, abs=NEAR)


@pytest.mark.parametrize('set_up', ['spring_stabilised_inner', 'spring_stabilised_outer'])
def test_an_imu_mounted_the_wrong_way_round_is_found_by_the_model(sound, set_up):
    spoilt = fault_injection.mirrored(('imu_angle', 'imu_rate'))(sound[set_up])
    _, found = findings(spoilt, 'sign_error')
    assert {f.where for f in found} == {'imu_angle', 'imu_rate'}
    assert check_recording(spoilt).verdict != 'unusable'  # without a model nobody can tell


@pytest.mark.parametrize(('set_up', 'channel'), MOVING)
def test_flat_tops_are_found(sound, set_up, channel):
    report, found = findings(
        fault_injection.clipped(channel, 0.9)(sound[set_up]), 'sensor_clipping'
    )
    assert report.verdict == 'unusable'
    assert {f.where for f in found} == {channel}


def test_a_torque_that_really_ends_at_a_limit_is_no_fault():
    machine = machine_of('torque_saturation', limit=7.0)
    raw = fault_injection.as_recorded(record_of(machine, 'swing_outer_fixed', 5), 5)
    torque = raw.topics['/applied_torque'].values['hip_torque']
    limit = 1.0 - float(np.mean(np.abs(torque) > 7.0))
    report, found = findings(fault_injection.clipped('hip_torque', limit)(raw), 'sensor_clipping')
    assert not found
    assert report.of('saturation')


@pytest.mark.parametrize(
    ('topic', 'size', 'set_up'),
    [
        (topic, size, SET_UPS[(i + k) % len(SET_UPS)])
        for i, topic in enumerate(TOPICS)
        for k, size in enumerate([0.003, -0.003, 0.05, -0.05, 0.5, -0.5])
    ],
)
def test_a_clock_that_jumps_is_put_right(sound, topic, size, set_up):
    raw = sound[set_up]
    whole = to_record(raw)
    for arrivals in (True, False):
        # Of one topic alone, a jump by a sample and a half at slow motion needs the arrivals.
        if not arrivals and abs(size) < 0.01 and topic != fault_injection.ALL:
            continue
        spoilt = fault_injection.jumped(topic, size, AT)(raw)
        report, found = findings(spoilt, 'clock_jump', arrivals)
        assert report.verdict == 'warnings'
        assert found[0].repair
        assert found[0].value == pytest.approx(size, abs=1e-6)
        assert found[0].start_s == pytest.approx(AT + min(size, 0.0), abs=0.005)
        mended = to_record(spoilt if arrivals else fault_injection.without_arrivals(spoilt))
        np.testing.assert_array_equal(mended.stamp_ns, whole.stamp_ns)
        for channel, values in whole.outputs.items():
            np.testing.assert_array_equal(mended.outputs[channel], values)


@pytest.mark.parametrize(
    ('topic', 'ratio', 'set_up'),
    [
        (topic, ratio, SET_UPS[(i + k) % len(SET_UPS)])
        for i, topic in enumerate(TOPICS)
        for k, ratio in enumerate([2, 5])
    ],
)
def test_a_change_of_rate_is_harmless_only_with_right_stamps(sound, topic, ratio, set_up):
    raw = sound[set_up]
    report, found = findings(
        fault_injection.decimated(topic, ratio, AT)(raw), 'sampling_rate_change'
    )
    assert report.verdict == 'warnings'
    assert found[0].start_s == pytest.approx(AT, abs=NEAR)
    if set_up == 'swing_inner_fixed' and topic == '/imu':
        return  # at rest it may report whenever it likes
    for arrivals in (True, False):
        spoilt = fault_injection.decimated(topic, ratio, AT, honest=False)(raw)
        report, found = findings(spoilt, 'sampling_rate_change', arrivals)
        assert report.verdict == 'unusable'
        assert any(f.start_s == pytest.approx(AT, abs=NEAR) for f in found)


@pytest.mark.parametrize('topic', TOPICS)
@pytest.mark.parametrize('set_up', ['spring_stabilised_outer', 'swing_inner_fixed'])
def test_lost_samples_are_told(sound, set_up, topic):
    raw = sound[set_up]
    for fault in (
        fault_injection.thinned(topic, 0.02, 1),
        fault_injection.interrupted(topic, 0.05, AT),
    ):
        report, found = findings(fault(raw), 'dropped_samples')
        assert report.verdict == 'warnings'
        assert found[0].repair
    if set_up == 'swing_inner_fixed' and topic == '/imu':
        return  # at rest no sample is missed
    for fault in (
        fault_injection.thinned(topic, 0.02, 1, honest=False),
        fault_injection.interrupted(topic, 0.05, AT, honest=False),
    ):
        report, found = findings(fault(raw), 'dropped_samples')
        assert report.verdict == 'unusable'


def test_a_torque_that_is_missing_for_long_is_not_made_up(sound):
    spoilt = fault_injection.interrupted('/applied_torque', 0.5, AT)(sound['swing_outer_fixed'])
    report, found = findings(spoilt, 'dropped_samples')
    assert report.verdict == 'unusable'
    assert found[0].start_s == pytest.approx(AT, abs=0.005)


@pytest.mark.parametrize('length', [0.004, 0.02, 0.1])
def test_a_torque_that_is_missing_for_short_is_filled(sound, length):
    raw = sound['spring_stabilised_inner']
    whole, spoilt = (
        to_record(raw),
        fault_injection.interrupted(fault_injection.ALL, length, AT)(raw),
    )
    filled = to_record(spoilt)
    np.testing.assert_array_equal(filled.stamp_ns, whole.stamp_ns)
    torque = whole.inputs['hip_torque']
    # A cubic over h s misses a sine of amplitude A by A (omega h)^4 / 384 in its middle; up to
    # 2.5 Hz, with 7 N m RMS, and slopes over one sample of 2 ms.
    omega = 2 * np.pi * 2.5
    bound = 14.0 * ((omega * length) ** 4 / 384 + omega**2 * length * 0.002 / 4)
    assert np.abs(filled.inputs['hip_torque'] - torque).max() < bound


def test_a_fault_in_a_bag_is_told_where_the_bag_is_taken_in(tmp_path):
    record = record_of(machine_of(), 'spring_stabilised_outer', 3)
    later = record.time > AT
    shifted = replace(
        record,
        outputs={
            **record.outputs,
            'imu_angle': record.outputs['imu_angle'] + 0.005 * later,
        },
    )
    jumped = replace(record, stamp_ns=record.stamp_ns + np.where(later, 40_000_000, 0))
    paths = [
        write_bag(tmp_path / name, spoilt)
        for name, spoilt in {'shifted': shifted, 'jumped': jumped}.items()
    ]
    loaded = load_bags(paths, MODEL)
    (unusable,) = loaded.left_out
    assert unusable.name == 'shifted'
    assert 'imu_angle 3.2' in unusable.reason
    assert [f.code for f in unusable.faults] == ['zero_shift']
    used = next(source for source in loaded.sources if source.name == 'jumped')
    assert {f.code for f in used.check.findings if f.repair} == {'clock_jump'}
    np.testing.assert_array_equal(read_bag(paths[1]).stamp_ns, record.stamp_ns)


@pytest.mark.parametrize(('gap', 'verdict'), [(0.02, 'warnings'), (0.005, 'unusable')])
def test_a_step_within_the_play_of_the_model_is_odd_only(sound, tmp_path, gap, verdict):
    path = tmp_path / 'play.yaml'
    Model.load(MODEL).with_effect('backlash', gap=gap).save(path)
    raw = fault_injection.shifted('hip_angle', 0.01, AT)(sound['spring_stabilised_outer'])
    report = check_recording(raw, path)
    assert {f.where for f in report.of('zero_shift')} == {'hip_angle'}
    assert report.verdict == verdict


def test_a_joint_at_rest_may_slip_as_far_as_friction_allows():
    # The pendulum rests within 18 mrad (results.md); this one slips between two samples.
    time = np.arange(4000) / 500.0
    swing = 0.5 * np.sin(4.0 * time) * np.clip(time - 5.0, 0.0, 1.0) ** 3
    for size, verdict in ((0.012, 'warnings'), (0.03, 'unusable')):
        raw = synthesise(Synthesis(mechanism='pendulum', quantum=0.0, noise=1e-4), 0)
        states = raw.topics['/joint_states']
        noise = 1e-4 * np.random.default_rng(0).standard_normal(len(time))
        moved = swing + noise + size * (time > 3.0)
        topics = {**raw.topics, '/joint_states': replace(states, values={'angle': moved})}
        report = check_recording(replace(raw, topics=topics), model_path('sydney_pendulum'))
        assert {f.where for f in report.of('zero_shift')} == {'angle'}
        assert report.verdict == verdict


def test_a_joint_that_turns_is_none_that_rests():
    # Friction would let the hip rest 97 mrad off, but where it turns it does not rest.
    def torque(time):
        return 6.0 * np.sin(2 * np.pi * (0.7 + 0.2 * time) * time)

    record = rehearse(
        'turns',
        Model.load(MODEL),
        Setup('inner', 'inner_fixed'),
        [0.25, 0.5],
        [torque],
        3.0,
        0.004,
        1,
    )
    shifted = replace(
        record,
        outputs={
            **record.outputs,
            'hip_angle': record.outputs['hip_angle'] + 0.03 * (record.time > 1.5),
        },
    )
    report = check_recording(fault_injection.as_recorded(shifted, 1), MODEL)
    assert {f.where for f in report.of('zero_shift')} == {'hip_angle'}
    assert report.verdict == 'unusable'


def test_a_bag_that_is_used_anyway_is_told_in_answer_and_report(tmp_path):
    record = record_of(machine_of(), 'spring_stabilised_outer', 3)
    shifted = replace(
        record,
        outputs={
            **record.outputs,
            'imu_angle': record.outputs['imu_angle'] + 0.005 * (record.time > AT),
        },
    )
    path = write_bag(tmp_path / 'shifted', shifted)
    loaded = load_bags([path], MODEL, use_anyway=['zero_shift'])
    assert not loaded.left_out
    assert len(loaded.records) == 1
    facts = unusable_facts(Model.load(MODEL), loaded, 'Too few.', {'options': {}})
    (entry,) = facts['overruled']
    assert (entry['name'], entry['code'], entry['where']) == ('shifted', 'zero_shift', 'imu_angle')
    said = 'shifted used in spite of what the check finds: zero_shift.'
    assert facts['summary'] == f'Too few. {said}'
    page = render(facts, [])
    assert 'Used anyway' in page
    assert 'imu_angle 3.2' in page
    with pytest.raises(ValueError, match='shift'):
        load_bags([path], MODEL, use_anyway=['shift'])
