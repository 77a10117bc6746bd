"""Landings that bounce or slide, hidden in walking records: named, measured, and no false alarm.

The machines walk by hybrid.walk at a finer step, seen by noisy, quantised sensors whose stamps
jitter, or in MuJoCo, which shares no code with the model (mujoco_walker.py).
"""

import functools
import math

import numpy as np
import pytest
from walking import NOISE, QUANTUM, RATE, SLOPE, stepping_command, walking
from walking_records import as_record

from cg_description.paths import model_path
from cg_dynamics.effects.effect import ContactLaw
from cg_dynamics.model import Model
from cg_dynamics.rig import Setup
from cg_dynamics.walking.contact import Ground, contact_law
from cg_dynamics.walking.gait import section_state
from cg_sysid.checks.loading import Loaded
from cg_sysid.diagnosis.diagnose import diagnose
from cg_sysid.diagnosis.result import Options
from cg_sysid.identification.data_set import noise_floor
from cg_sysid.landings.contact_fit import ContactTask, fit_contact
from cg_sysid.landings.impulse import measure_impulse
from cg_sysid.landings.landings import ready, simulate_passage
from cg_sysid.landings.selection import judge_landings
from cg_sysid.records.record import Record
from cg_sysid.report.facts import diagnosis_facts
from cg_sysid.report.landings import landings as card
from cg_sysid.report.wording import lead
from cg_sysid.stances.phases import cut_steps

# One process makes the walks for all of these tests.
pytestmark = pytest.mark.xdist_group('landings')

MODEL = model_path('compass_gait_mit')
FEW = ('impact_restitution', 'foot_slip', 'torque_bias', 'payload')


@functools.cache
def nominal():
    return Model.load(MODEL)


@functools.cache
def machine(ground=(), other=()):
    """The robot on a ground, ((effect, parameter, value), ...), with other lumps if asked."""
    model = nominal()
    if other:
        model = model.with_values({k: model.values[k] * f for k, f in other})
    for effect, parameter, value in ground:
        model = model.with_effect(effect, None, **{parameter: value})
    return model


@functools.cache
def recorded(ground, other, seeds, duration=2.1):
    model = machine(ground, other)
    walks = [walking(model, seed, duration, stance=('inner', 'outer')[seed % 2]) for seed in seeds]
    return [
        as_record(f'walk_{seed}', done, done.arcs[0].stance, seed)
        for seed, done in zip(seeds, walks, strict=True)
    ], walks


@functools.cache
def passages(ground=(), seeds=(0, 1)):
    """Landings of a machine, made ready with the model that only lacks its ground."""
    records, walks = recorded(ground, (), seeds)
    sigma = noise_floor(nominal(), records)
    cut = cut_steps(records, nominal())
    return ready(nominal(), cut.landings, sigma), sigma, walks, cut


def here(function, arguments, what):
    return [function(*each) for each in arguments]


BOUNCY = (('impact_restitution', 'coefficient', 0.3),)
SOFTER = (('impact_restitution', 'coefficient', 0.1),)
SLIPPERY = (('foot_slip', 'friction', 0.35),)


# --- the law of contact ------------------------------------------------------------------------


@pytest.mark.parametrize(
    ('ground', 'effect', 'value'),
    [
        (SOFTER, 'impact_restitution', 0.1),
        pytest.param(SLIPPERY, 'foot_slip', 0.35, marks=pytest.mark.evidence),
    ],
)
def test_the_law_comes_back_inside_its_interval(ground, effect, value):
    found, sigma, _, _ = passages(ground)
    fit = fit_contact(ContactTask(nominal(), ContactLaw(), (effect,), tuple(found[:5]), (), sigma))
    estimate, spread = fit.values[effect]
    # Three standard deviations, and half a per cent for stamps that jitter and steps of 2 ms.
    assert abs(estimate - value) < 3 * spread + 0.005 * value
    assert spread < 0.02 * value + 0.003
    # Down to the noise: about 2000 samples.
    assert fit.chi2 / fit.samples < 1.15


def test_plastic_landings_are_simulated_down_to_the_noise():
    found, sigma, walks, _ = passages()
    assert len(found) == sum(len(done.impacts) for done in walks)
    fit = fit_contact(ContactTask(nominal(), ContactLaw(), (), tuple(found), (), sigma))
    assert fit.chi2 / fit.samples < 1.15
    # Where the ground is, to what the noise of two angles says.
    np.testing.assert_allclose([own[4] for own in fit.own], SLOPE, atol=3e-3)


def test_a_landing_backwards_is_simulated_too():
    done = walking(nominal(), 4, 1.6)
    record = as_record('walk', done, 'inner', mirrored=True)
    sigma = noise_floor(nominal(), [record])
    found = ready(nominal(), cut_steps([record], nominal()).landings, sigma)
    assert found[0].backwards
    fit = fit_contact(ContactTask(nominal(), ContactLaw(), (), tuple(found), (), sigma))
    assert fit.chi2 / fit.samples < 1.15


def test_delayed_torque_and_sensors_are_known_in_a_landing():
    late = machine().with_effect('actuator_delay', delay=0.008)
    late = late.with_effect('sensor_delay', delay=0.006)
    found, _, _, _ = passages()
    passage = found[1]
    plain = simulate_passage(nominal(), passage, ContactLaw(), passage.centre)
    moved = simulate_passage(late, passage, ContactLaw(), passage.centre)
    # Sensors that are 6 ms late show what was 3 rows before; the torque's share is the rest.
    shifted = np.abs(moved[6:] - plain[3:-3])[:, :1].max()
    assert shifted < 0.25 * np.abs(moved - plain)[:, :1].max()


# --- the robot as a force plate ----------------------------------------------------------------


def test_measured_impulses_are_those_of_the_ground():
    for ground in ((), SLIPPERY):
        found, sigma, walks, _ = passages(ground)
        law = contact_law(machine(ground))
        true = [event.impact.impulse for done in walks for event in done.impacts]
        along, off = Ground(SLOPE).tangent, Ground(SLOPE).normal
        for passage, impulse in zip(found, true, strict=True):
            fit = fit_contact(ContactTask(nominal(), law, (), (passage,), (), sigma))
            measured = measure_impulse(nominal(), passage, law, fit.own[0], sigma)
            expected = np.array([along @ impulse, off @ impulse])
            spread = np.sqrt(np.diag(measured.covariance))
            # Parabolas over 20 ms forget the change of acceleration: a tenth of a newton second.
            assert (np.abs(measured.measured - expected) < 4 * spread + 0.15).all()
            if not ground:
                np.testing.assert_allclose(measured.plastic, expected, atol=0.3)


# --- the jury ----------------------------------------------------------------------------------


def test_plastic_landings_are_not_accused():
    _, sigma, _, cut = passages()
    found = judge_landings(nominal(), cut.landings, sigma, here)
    assert found.accepted == ()
    assert not found.tried  # nothing is left to explain
    assert found.judged == len(cut.landings)


@pytest.mark.evidence
def test_a_payload_that_nobody_found_is_no_bounce_and_no_slide():
    """The phases' numbers take most of it up; what is left after landings is not accused."""
    records, _ = recorded((('payload', 'mass', 1.2),), (), (0, 1), 2.0)
    cut = cut_steps(records, nominal())
    sigma = noise_floor(nominal(), records)
    found = judge_landings(nominal(), cut.landings, sigma, here, ['impact_restitution'])
    assert found.tried
    assert found.accepted == ()


def test_too_few_landings_are_not_judged():
    _, sigma, _, cut = passages()
    assert judge_landings(nominal(), cut.landings[:3], sigma, here) is None


# --- the whole diagnosis -----------------------------------------------------------------------

LUMPS = (('c1', 1.12), ('c2', 0.9), ('c4', 0.88), ('c5', 1.1))


@pytest.mark.evidence
@pytest.mark.slow
@pytest.mark.parametrize(
    'ground',
    [(), *(pytest.param(ground, marks=pytest.mark.evidence) for ground in (BOUNCY, SLIPPERY))],
    ids=['plastic', 'bouncy', 'slippery'],
)
def test_the_ground_is_named_in_a_robot_of_other_numbers(ground):
    records, _ = recorded(ground, LUMPS, (0, 1))
    cut = cut_steps(records, nominal())
    # A slide is slow to try and as slow to rule out: once, where there is one, is enough.
    tried = [e for e in FEW if e != 'foot_slip' or ground == SLIPPERY]
    options = Options(effects=tuple(tried), workers=1)
    found = diagnose(nominal(), cut.records, options, landings=cut.landings)
    if not ground:
        assert found.verdict == 'consistent', found.summary
        assert found.landings.judged >= 4
        assert 'plastic' in found.summary
        return
    ((effect, parameter, value),) = ground
    assert [cause.label for cause in found.causes] == [effect], found.summary
    assert found.verdict == 'explained'
    estimate, spread, _ = found.causes[0].parameters[parameter]
    assert abs(estimate - value) < 4 * spread + 0.01 * value
    assert (found.landings.after < found.landings.before).all()
    assert contact_law(found.extended.train.model) != ContactLaw()
    assert contact_law(found.model) == contact_law(found.extended.train.model)
    facts = diagnosis_facts(found, Loaded(cut.records, (), cut.origin), {})
    page = card(facts)
    assert page.count('<circle') == 2 * len(facts['landings']['impulses']) > 0
    assert ('cone of friction' in page) == (effect == 'foot_slip')
    assert lead(facts) == facts['landings']['text']
    assert facts['ranking'][-1]['accepted'] == effect
    if ground == SLIPPERY:
        return
    # The model that comes out explains the landings, and is not accused again.
    sigma = found.held[0].sigma
    again = judge_landings(found.extended.train.model, cut.landings, sigma, here)
    assert again.accepted == ()


def test_without_landings_the_diagnosis_is_what_it_was():
    records, _ = recorded((), (), (0, 1))
    cut = cut_steps(records, nominal())
    found = diagnose(nominal(), cut.records, Options(effects=('torque_bias',), workers=1))
    assert found.landings is None
    assert found.verdict == 'consistent'


# --- MuJoCo ------------------------------------------------------------------------------------


def in_mujoco(values, seed, friction):
    """A record of a robot that walks in MuJoCo."""
    from mujoco_walker import MujocoWalker

    stance = ('inner', 'outer')[seed % 2]
    v, c = values['viscous_friction.coefficient'], values['coulomb_friction.torque']
    rng = np.random.default_rng([seed, 1])
    start = np.array([0.2, 1.0, 0.0]) + rng.uniform(-1, 1, 3) * [0.01, 0.08, 0.2]
    robot = MujocoWalker(
        values, stance, section_state(start, stance, SLOPE), SLOPE, friction,
        lambda rate: -v * rate - c * math.tanh(rate / 0.01),
    )  # fmt: skip
    command, states, torque = stepping_command(seed), [], []
    for k in range(round(2.1 * RATE)):
        states.append(robot.state)
        torque.append(command(k / RATE, robot.stance, robot.state)[0])
        robot.advance(torque[-1], 1 / RATE)
    x = np.array(states)
    outputs = {'imu_angle': x[:, 0], 'imu_rate': x[:, 2], 'hip_angle': x[:, 0] - x[:, 1]}
    for channel, values_ in outputs.items():
        read = values_ + NOISE[channel] * rng.standard_normal(len(x))
        q = QUANTUM.get(channel, 0.0)
        outputs[channel] = np.rint(read / q) * q if q else read
    stamps = (1e9 * np.arange(len(x)) / RATE).round().astype(np.int64)
    return Record(f'walk_{seed}', stamps, {'hip_torque': np.array(torque)}, outputs,
                  'compass_gait', Setup(stance=stance))  # fmt: skip


@pytest.mark.evidence
@pytest.mark.slow
@pytest.mark.parametrize('friction', [pytest.param(2.0, marks=pytest.mark.evidence), 0.35])
def test_the_ground_of_another_engine_is_named(friction):
    pytest.importorskip('mujoco', reason='MuJoCo is not installed')
    from mujoco_robot import two_links

    bare = nominal().with_values(two_links(nominal().values))
    truth = {**bare.values, 'c1': 1.1 * bare.values['c1'], 'c5': 0.92 * bare.values['c5']}
    records = [in_mujoco(truth, seed, friction) for seed in (0, 1)]
    # As a user of the library would: the records as they are.
    found = diagnose(bare, records, Options(effects=FEW, workers=1))
    if friction > 1:
        assert found.verdict == 'consistent', found.summary
        return
    assert [cause.label for cause in found.causes] == ['foot_slip'], found.summary
    # The engine's ground gives way for a millisecond of a slide of 50: some per cent.
    assert found.causes[0].parameters['friction'][0] == pytest.approx(friction, rel=0.06)
