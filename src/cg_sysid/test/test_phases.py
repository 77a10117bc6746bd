"""Touchdowns in recordings, and walking records as stance phases."""

import math
from dataclasses import replace

import numpy as np
import pytest
from walking import SLOPE, stepping_command, walking
from walking_records import as_record

from cg_description.paths import model_path
from cg_dynamics.model import Model
from cg_dynamics.rig import Setup
from cg_sysid.checks.loading import load_bags
from cg_sysid.checks.recordings import check_recording
from cg_sysid.diagnosis.diagnose import split
from cg_sysid.experiments.rehearsal import rehearse
from cg_sysid.identification.data_set import prepare
from cg_sysid.records.bags import write_bag
from cg_sysid.stances.phases import cut_steps
from cg_sysid.stances.touchdown import Pieces, find_touchdowns

MODEL = model_path('compass_gait_mit')
# The instant of a landing is not sampled, noise moves where the legs pose as they do there by a
# sample or two, and a slide begins with a jump of the rates that hides in noise for some samples.
NEAR = {'plastic': 0.006, 'impact_restitution': 0.012, 'foot_slip': 0.012}
GROUNDS = {
    'plastic': {},
    'impact_restitution': {'coefficient': 0.3},
    'foot_slip': {'friction': 0.3},
}


@pytest.fixture(scope='module')
def nominal():
    return Model.load(MODEL)


def on(model, ground):
    return model.with_effect(ground, **GROUNDS[ground]) if GROUNDS[ground] else model


@pytest.mark.parametrize('ground', GROUNDS)
@pytest.mark.parametrize('stance', ['inner', 'outer'])
def test_touchdowns_are_found_on_any_ground(nominal, ground, stance):
    done = walking(on(nominal, ground), seed=1, stance=stance)
    found = find_touchdowns(as_record('walk', done, stance), nominal)
    assert len(done.impacts) >= 2
    assert [t.stance for t in found] == [e.stance for e in done.impacts]
    off = [t.time - e.time for t, e in zip(found, done.impacts, strict=True)]
    assert np.abs(off).max() < NEAR[ground], off
    np.testing.assert_allclose([t.slope for t in found], SLOPE, atol=4e-3)


@pytest.mark.parametrize(
    'spoilt',
    [
        {'noise': {'imu_angle': 2e-3, 'imu_rate': 2e-2, 'hip_angle': 3e-4}},
        {'quantum': {'hip_angle': 2 * math.pi / 4096}},
        {'jitter': 0.45},
    ],
)
def test_touchdowns_are_found_with_worse_sensors(nominal, spoilt):
    done = walking(nominal, seed=2)
    found = find_touchdowns(as_record('walk', done, 'inner', **spoilt), nominal)
    off = [t.time - e.time for t, e in zip(found, done.impacts, strict=True)]
    assert np.abs(off).max() < 0.012, off


def test_an_encoder_that_was_zeroed_wrongly_hides_no_step(nominal):
    done = walking(nominal, seed=3)
    record = as_record('walk', done, 'inner')
    outputs = {**record.outputs, 'hip_angle': record.outputs['hip_angle'] + 0.02}
    found = find_touchdowns(replace(record, outputs=outputs), nominal)
    off = [t.time - e.time for t, e in zip(found, done.impacts, strict=True)]
    assert np.abs(off).max() < 0.012, off


def test_steps_backwards_are_steps(nominal):
    """The robot has no front: the mirror image of a walk is one."""
    done = walking(nominal, seed=4)
    found = find_touchdowns(as_record('walk', done, 'inner', mirrored=True), nominal)
    off = [t.time - e.time for t, e in zip(found, done.impacts, strict=True)]
    assert np.abs(off).max() < 0.012, off
    np.testing.assert_allclose([t.slope for t in found], -SLOPE, atol=4e-3)


@pytest.mark.parametrize('stance', ['inner', 'outer'])
def test_a_step_in_a_robot_of_other_numbers_is_found(nominal, stance):
    """Lumps 15 % off and a payload: the model is wrong, but not about which foot is held."""
    other = {'c1': 1.15, 'c2': 0.87, 'c4': 0.9, 'c5': 1.1}
    machine = nominal.with_values({k: nominal.values[k] * f for k, f in other.items()})
    machine = machine.with_effect('payload', mass=1.5, distance=0.4)
    done = walking(machine, seed=5, stance=stance)
    found = find_touchdowns(as_record('walk', done, stance), nominal)
    off = [t.time - e.time for t, e in zip(found, done.impacts, strict=True)]
    assert len(done.impacts) >= 1
    assert np.abs(off).max() < 0.012, off


# --- no steps ----------------------------------------------------------------------------------


def on_blocks(model, stance='inner', kick=None, seed=0):
    """A robot on blocks whose leg swings through the pose of a step, and on."""
    start = np.array([SLOPE - 0.2, SLOPE + 0.2, 1.1, 0.0])
    start = start if stance == 'inner' else start[[1, 0, 3, 2]]
    if kick is not None:
        model = model.with_effect('external_push', impulse=kick, instant=0.5, duration=0.01)
    torque = stepping_command(seed)
    # No feedback: the torque of a walk that lands there.
    plan = [torque(t, stance, s) for t, s in _pinned_walk(model, stance, start, torque)]
    return rehearse(
        f'blocks_{stance}', model, Setup(stance=stance), start,
        [lambda t: plan[min(round(t / 0.002), len(plan) - 1)][0]], 0.8, seed=seed,
    )  # fmt: skip


def _pinned_walk(model, stance, start, torque):
    from cg_dynamics.walking.hybrid import WalkOptions, walk

    options = WalkOptions(minimum_step=10.0, sample_time=0.002)
    done = walk(model, stance, start, 0.8, torque, options)
    arc = done.arcs[0]
    return list(zip(arc.time[::2], arc.states[::2], strict=True))


@pytest.mark.parametrize('stance', ['inner', 'outer'])
@pytest.mark.parametrize('kick', [None, 3.0, -3.0])
def test_a_leg_that_swings_on_has_not_stepped_even_if_it_is_kicked(nominal, stance, kick):
    record = on_blocks(nominal, stance, kick)
    q = record.outputs['imu_angle']
    pose = q + (q - record.outputs['hip_angle']) - 2 * SLOPE
    apart = np.abs(record.outputs['hip_angle']) > 0.2
    assert (np.diff(np.sign(pose[apart])) != 0).any(), 'the legs never pose as in a step'
    cut = cut_steps([record], nominal)
    assert cut.records[0] is record
    assert not cut.landings


def test_records_of_rigs_that_hold_the_robot_are_left_alone(nominal):
    done = walking(nominal, seed=1)
    record = as_record('walk', done, 'inner')
    held = replace(record, setup=Setup(fixture='legs_tied'))
    cut = cut_steps([held], nominal)
    assert cut.records == (held,)
    assert cut.origin == {'walk': 'walk'}


def test_legs_that_pass_and_scuff_are_no_touchdown(nominal):
    """Until the first touchdown the legs pass once; nothing is found there."""
    done = walking(nominal, seed=1, duration=0.45)
    assert not done.impacts
    record = as_record('walk', done, 'inner')
    hip = record.outputs['hip_angle']
    assert hip[0] * hip[-1] < 0
    assert not find_touchdowns(record, nominal)
    # A scuff: the swing leg loses a tenth of its rate as the feet pass.
    k = int(np.argmin(np.abs(hip)))
    knocked = hip.copy()
    rate = np.gradient(hip, record.time)[k]
    knocked[k:] -= 0.1 * rate * (record.time[k:] - record.time[k])
    outputs = {**record.outputs, 'hip_angle': knocked}
    assert not find_touchdowns(replace(record, outputs=outputs), nominal)


# --- phases ------------------------------------------------------------------------------------


@pytest.mark.parametrize('ground', [
    pytest.param(ground, marks=pytest.mark.evidence) if ground != 'impact_restitution' else ground
    for ground in GROUNDS
])  # fmt: skip
def test_phases_hold_no_sample_of_a_bounce_or_a_slide(nominal, ground):
    machine = on(nominal, ground)
    walks = [walking(machine, seed=k, stance=s) for k, s in ((0, 'inner'), (1, 'outer'))]
    records = [
        as_record(f'walk_{k}', done, done.arcs[0].stance, k) for k, done in enumerate(walks)
    ]
    cut = cut_steps(records, nominal)
    assert len(cut.landings) == sum(len(done.impacts) for done in walks)
    pieces = {record.name: Pieces(record, machine) for record in records}
    for phase in cut.records:
        name = phase.name[: len('walk_0')]
        whole = pieces[name].record.stamp_ns[0]
        start, stop = ((stamp - whole) / 1e9 for stamp in phase.stamp_ns[[0, -1]])
        # The pinned machine itself explains it down to the noise: 500 samples and more, so that
        # chi2/N scatters by less than a tenth; the gentle end of a slide may be left in it.
        misfit = pieces[name].misfit(phase.setup.stance, start, stop)
        assert misfit < (1.2 if ground == 'plastic' else 1.5), phase.name
    lost = 1 - sum(p.duration for p in cut.records) / sum(r.duration for r in records)
    assert lost < {'plastic': 0.06, 'impact_restitution': 0.15, 'foot_slip': 0.25}[ground]


def test_both_stances_are_trained_on_and_held_out(nominal):
    done = walking(nominal, seed=1)
    cut = cut_steps([as_record('walk', done, 'inner')], nominal)
    for side in split(prepare(nominal, cut.records)):
        assert {data_set.setup.stance for data_set in side} == {'inner', 'outer'}


def test_bags_of_a_walking_robot_pass_the_check_and_are_cut(nominal, tmp_path):
    bags = []
    for k, ground in enumerate(GROUNDS):
        done = walking(on(nominal, ground), seed=k, duration=2.2)
        bags.append(write_bag(tmp_path / ground, as_record(ground, done, 'inner', k)))
        assert check_recording(bags[-1], MODEL).verdict != 'unusable'
    loaded = load_bags(bags, MODEL)
    assert not loaded.left_out
    assert set(loaded.steps) == set(GROUNDS)
    assert set(loaded.origin.values()) == set(GROUNDS)
    assert all(record.name in loaded.origin for record in loaded.records)
    assert len(loaded.records) > len(loaded.landings)
