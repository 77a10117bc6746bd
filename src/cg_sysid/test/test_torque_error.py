"""What torques say of a robot before anything is simulated."""

from dataclasses import replace

import finger
import numpy as np
import pytest
from hanging_arm import nominal, recorded
from scipy import optimize, stats
from slide import CART_POLE, ride

from cg_dynamics.effects.backlash import Backlash
from cg_dynamics.model import Model
from cg_dynamics.rig import Setup
from cg_sysid.deadline import Deadline
from cg_sysid.diagnosis.diagnose import Options, diagnose
from cg_sysid.identification import torque_error
from cg_sysid.identification.data_set import prepare
from cg_sysid.identification.identify import fit
from cg_sysid.identification.student_t import SCALED, TAILS, deviance, row_scale, scale_of
from cg_sysid.identification.torque_error import (
    all_rows,
    can,
    fit_by_torque,
    fits_by_torque,
    left_by,
    problems_of,
)
from cg_sysid.identification.windows import followed
from cg_sysid.search import look
from cg_sysid.search.outcome import shared_unknowns
from cg_sysid.search.starts import starts_of
from cg_sysid.search.task import Rival, Task, candidates_for
from cg_sysid.search.torque_screening import HINT, KEPT, SEEN, WORST, Scores, scores
from cg_sysid.search.whole_fit import try_candidate

OFF = {
    'thigh_mass': 1.12, 'shank_mass': 0.9, 'coulomb_friction@hip_joint.torque': 0.3,
    'viscous_friction@shank_joint.coefficient': 0.16, 'coulomb_friction@thigh_joint.torque': 0.11,
}  # fmt: skip


@pytest.fixture(scope='module')
def believed():
    return nominal()


def data(model, believed, seeds=(1, 2)):
    return prepare(believed, [recorded(model, 4.0, seed) for seed in seeds])


def test_numbers_are_found_with_no_simulation(believed):
    true = believed.with_values(OFF)
    found = fit_by_torque(believed, data(true, believed))
    assert can(believed)
    # Biased by smoothing over 0.12 s; what the bodies weigh together is what torques show.
    for name in ('coulomb_friction@hip_joint.torque', 'viscous_friction@shank_joint.coefficient'):
        assert found.values[name] == pytest.approx(OFF[name], rel=0.15)
    assert (found.relative < 0.05).all()
    wrong = fit_by_torque(believed, data(true, believed), only=())
    assert (wrong.relative > 2 * found.relative).any()


def test_starts_that_differ_in_what_torques_do_not_see_come_to_one_fit(believed):
    data_sets = data(believed.with_values(OFF), believed)
    delays, biases = (0.005, 0.015), (0.1, -0.3)
    late = [believed.with_effect('actuator_delay', None, delay=d) for d in delays]
    found = fits_by_torque(late, data_sets)
    assert [f.values['actuator_delay.delay'] for f in found] == list(delays)
    assert found[0].deviance == found[1].deviance
    # What they do see is fitted from each start, and comes to one number.
    pulled = [believed.with_effect('torque_bias', 'hip_joint', bias=b) for b in biases]
    found = fits_by_torque(pulled, data_sets)
    values = [f.values['torque_bias@hip_joint.bias'] for f in found]
    assert values[0] != values[1]
    # 1.0e-3 N m apart: descents end where a step promises less than SETTLED of the cost, and each
    # weighs by what it leaves itself.
    assert values[0] == pytest.approx(values[1], abs=3e-3)


def test_a_fit_by_simulation_goes_on_from_there(believed):
    true = believed.with_values(OFF)
    found = fit(believed, data(true, believed))
    assert found.normalised_error < 1.1
    values = dict(zip([u.name for u in found.unknowns], found.values, strict=True))
    for name in ('coulomb_friction@hip_joint.torque', 'viscous_friction@shank_joint.coefficient'):
        assert values[name] == pytest.approx(OFF[name], rel=0.02)


@pytest.mark.parametrize(
    ('name', 'at', 'sizes'),
    [
        ('stribeck_friction', 'thigh_joint', {'torque': 0.3, 'stribeck_rate': 0.4}),
        pytest.param('torque_constant', 'shank_joint', {'error': 0.3}, marks=pytest.mark.evidence),
        pytest.param('torque_bias', 'hip_joint', {'bias': 0.4}, marks=pytest.mark.evidence),
        pytest.param('cogging_torque', 'thigh_joint', {'cosine': 0.3}, marks=pytest.mark.evidence),
        pytest.param(
            'payload',
            'shank',
            {'mass': 0.5, 'x': 0.05, 'y': 0.06, 'z': -0.2},
            marks=pytest.mark.evidence,
        ),
        pytest.param('rotor_inertia', 'hip_joint', {'inertia': 0.08}, marks=pytest.mark.evidence),
        pytest.param(
            'quadratic_friction', 'shank_joint', {'coefficient': 0.1}, marks=pytest.mark.evidence
        ),
        pytest.param(
            'encoder_offset', 'thigh_joint_position', {'offset': 0.1}, marks=pytest.mark.evidence
        ),
        pytest.param('sensor_delay', None, {'delay': 0.012}, marks=pytest.mark.evidence),
        pytest.param('actuator_delay', None, {'delay': 0.02}, marks=pytest.mark.evidence),
    ],
)
def test_the_cause_is_worth_a_look(believed, name, at, sizes):
    effect = believed.with_effect(name, at).effects[-1]
    known = {p.name for p in effect.parameters}
    sizes = {n: v for n, v in sizes.items() if n in known} or {effect.parameters[0].name: 0.3}
    true = believed.with_values(OFF).with_effect(name, at, **sizes)
    train = data(true, believed)
    candidates = candidates_for(believed, [Setup()])
    assert (name, at) in candidates
    kept = scores(believed, train, candidates, {}).worth(candidates)
    assert (name, at) in kept
    assert len(kept) < len(candidates) / 2


@pytest.mark.evidence
def test_what_moves_by_itself_is_sought_where_a_simulation_misses_most(believed):
    # Said to be missed most is the joint that the torques suspect least.
    train = data(believed.with_values(OFF), believed)
    candidates = candidates_for(believed, [Setup()])
    joints = believed.mechanism.coordinates
    plain = scores(believed, train, candidates, {})
    last = plain.worst[-1]
    found = scores(
        believed, train, candidates, {},
        missed={f'{joint}_position': 9.0 if joint == last else 2.0 for joint in joints},
    )  # fmt: skip
    assert found.worst[:2] == (plain.worst[0], last)
    assert set(found.worst) == set(joints)
    assert ('backlash', last) not in plain.worth(candidates)
    assert ('backlash', last) in found.worth(candidates)


EVIDENCE = [pytest.param(link, marks=pytest.mark.evidence) for link in ('hip', 'shank')]


@pytest.mark.parametrize('link', ['thigh', *EVIDENCE])
def test_a_push_is_worth_a_look_on_the_link_that_it_is_on(believed, link):
    true = believed.with_values(OFF)
    about = believed.mechanism.joints_to(link)
    # Near the base, as the robot's own torques are larger there, a push is seen less well.
    sizes = {f'impulse_{joint}': 0.3 * (-1) ** k for k, joint in enumerate(about)}
    pushed = true.with_effect('external_push', link, instant=1.83, duration=0.04, **sizes)
    train = prepare(believed, [recorded(pushed, 4.0, 1), recorded(true, 4.0, 2)])
    candidates = candidates_for(believed, [Setup()])
    found = scores(believed, train, candidates, {})
    assert found.pushed == (('external_push', link),)
    kept = found.worth(candidates)
    assert [c for c in kept if c[0] == 'external_push'] == [('external_push', link)]


def test_a_push_is_seen_where_its_joint_turns_around_and_in_a_record_held_out(believed):
    true = believed.with_values(OFF)
    sound = recorded(true, 4.0, 1)
    at, time = sound.outputs['shank_joint_position'], sound.time
    # An extreme in the middle of the record, not at its ends.
    inner = np.flatnonzero((time > 1.2) & (time < 2.8))
    turns = inner[np.argmax(np.abs(at[inner] - np.interp(time[inner], time[inner[[0, -1]]],
                                                         at[inner[[0, -1]]])))]  # fmt: skip
    sizes = {f'impulse_{joint}': 0.06 for joint in believed.mechanism.joints_to('shank')}
    pushed = true.with_effect(
        'external_push', 'shank', instant=float(time[turns]), duration=0.04, **sizes
    )
    hit, other = prepare(believed, [recorded(pushed, 4.0, 1), recorded(true, 4.0, 2)])
    candidates = [('external_push', link) for link in believed.mechanism.bodies]
    for train, held in (([hit, other], []), ([other], [hit])):
        found = scores(believed, train, candidates, {}, held=held)
        assert found.pushed == (('external_push', 'shank'),)


def test_a_law_of_torque_that_gains_most_drives_out_no_delay_and_no_sensor():
    constant, late = ('torque_constant', 'hip_joint'), ('sensor_delay', None)
    off, bent, little = (('encoder_offset', f'{j}_position') for j in ('hip', 'thigh', 'shank'))
    gains = {constant: 300.0, late: 4.0, off: 30.0, bent: 12.0, little: SEEN / 2}
    found = Scores(gains, {constant: 280.0}, ('hip_joint',))
    assert found.worth(list(gains)) == [constant, late, off]
    # Of the ten machines of bench/robots.py with a delay none gains less than a twentieth.
    found = Scores(gains | {late: 0.5}, {constant: 280.0}, ('hip_joint',))
    assert found.worth(list(gains)) == [constant, off]
    # Nor does it drive out what a torque fit failed to follow, as a load and its link.
    load = ('payload', 'shank')
    fitted = {('torque_bias', f'joint_{k}'): 200.0 for k in range(KEPT)} | {load: -1e4}
    found = Scores(dict.fromkeys(fitted, 20.0) | {load: 250.0}, fitted, ('hip_joint',))
    assert load in found.worth([load])
    # Beside a better sensor a poorer one is not worth a look; alone it is.
    found = Scores(gains | {off: 0.0}, {constant: 280.0}, ('hip_joint',))
    assert found.worth(list(gains)) == [constant, late, bent]


def test_a_slope_gets_a_look_where_a_joint_moves_that_nothing_drives():
    """Torques take it for a constant of the drive, and deny it beside that."""
    slope, load = ('ground_slope', None), ('payload', 'pole')
    gains = {slope: 0.0, load: 50.0}
    for passive, looked_at in ((True, [slope, load]), (False, [load])):
        found = Scores(gains, {load: 50.0}, ('slide',), passive=passive)
        assert found.worth([slope, load]) == looked_at


@pytest.mark.parametrize(('joints', 'looks'), [(2, 16), (3, 10), (6, KEPT)])
def test_of_few_joints_more_candidates_are_looked_at(joints, looks):
    names = tuple(f'joint_{k}' for k in range(joints))
    laws = {('coulomb_friction', f'joint_{k}'): 30.0 - 0.1 * k for k in range(20)}
    best = ('torque_constant', None)
    fitted = laws | {best: 200.0}
    kept = Scores(fitted, fitted, names).worth(list(fitted))
    assert kept == [*list(laws)[: looks - 1], best]


def test_what_a_joint_loses_in_each_swing_is_looked_at_though_torques_hardly_show_it():
    joints = tuple(f'joint_{k}' for k in range(6))
    losses = [('viscous_friction', joint) for joint in joints]
    rub = {('coulomb_friction', joint): 0.5 for joint in joints}
    found = Scores(rub | dict.fromkeys(losses, 0.2), {}, joints)
    assert found.worth([*rub, *losses]) == losses[:WORST]


def test_where_torques_show_their_noise_alone_who_gains_most_rules_nobody_out():
    load, rub = ('payload', 'shank'), ('stribeck_friction', 'hip_joint')
    little = ('torque_bias', 'hip_joint')
    gains = {load: 280.0, rub: 10.5, little: HINT / 2}
    found = Scores(gains, {load: 280.0, rub: 10.5}, ('hip_joint',))
    assert found.worth(list(gains)) == [load]
    assert replace(found, at_noise=True).worth(list(gains)) == [load, rub]


@pytest.mark.parametrize(('noise', 'alone'), [(0.0, False), (3e-3, True)])
def test_whether_torques_show_their_noise_alone_is_told_by_that_of_the_encoders(
    believed, noise, alone
):
    # Dry friction is 1 N m where the model has 0.1.
    true = believed.with_values(OFF).with_effect('stribeck_friction', 'thigh_joint', torque=0.9)
    random = np.random.default_rng(5)
    train = [
        replace(
            d, outputs=d.outputs + noise * random.standard_normal(d.outputs.shape),
            sigma=np.hypot(d.sigma, noise),
        )
        for d in data(true, believed)
    ]  # fmt: skip
    assert scores(believed, train, [('torque_bias', 'hip_joint')], {}).at_noise == alone


def test_what_gains_by_a_fit_and_not_by_the_score_rules_nobody_out():
    """A torque constant may shrink all torques, and with them the masses and what is left."""
    names = 'arm_joint', 'pendulum_joint'
    friction, weak = ('stribeck_friction', 'arm_joint'), ('torque_constant', None)
    for scored, kept in ((0.0, [friction, weak]), (362.0, [weak])):
        gains, fitted = {friction: 29.0, weak: scored}, {friction: 33.0, weak: 362.0}
        assert Scores(gains, fitted, names).worth([friction, weak]) == kept


def test_rows_are_distributed_as_students_t():
    """Against SciPy's density at the scale that its own search finds the most likely."""
    random = np.random.default_rng(5)
    residual = random.standard_t(3, size=(400, 2)) * [0.2, 7.0]
    found, expected = deviance(residual), 0.0
    for column, scale in zip(residual.T, scale_of(residual), strict=True):

        def unlikely(log_scale, column=column):
            return -2 * stats.t.logpdf(column, TAILS, scale=np.exp(log_scale)).sum()

        best = optimize.minimize_scalar(unlikely, bracket=(-3.0, 3.0))
        assert scale == pytest.approx(np.exp(best.x), rel=2 * SCALED)
        constant = -2 * len(column) * stats.t.logpdf(0.0, TAILS)
        expected += best.fun - constant
    # At its minimum an error of the scale by SCALED is one of its square.
    assert found == pytest.approx(expected, abs=residual.size * SCALED**2)
    weights = 1 / row_scale(residual, scale_of(residual)) ** 2
    moved = 1e-6
    slope = (deviance(residual + moved) - deviance(residual - moved)) / (2 * moved)
    assert 2 * (weights * residual).sum() == pytest.approx(slope, rel=1e-3)


def test_a_model_that_is_off_where_friction_turns_is_not_worse_than_one_off_everywhere():
    random = np.random.default_rng(6)
    right = 0.01 * random.standard_normal((1000, 1))
    right[::20] = random.standard_normal((50, 1))
    wrong = 0.3 * random.standard_normal((1000, 1))
    assert np.abs(right).max() > np.abs(wrong).max()
    assert deviance(right) < deviance(wrong) - 1000


def test_a_load_and_its_link_are_known_together_and_count_together(believed):
    """Four numbers more, none of which the records tell apart from those of the link."""
    load = {'mass': 0.5, 'x': 0.05, 'y': 0.06, 'z': -0.2}
    true = believed.with_values(OFF).with_effect('payload', 'shank', **load)
    train = data(true, believed)
    alone, loaded, pulled = (
        fit(model, train) for model in (
            believed, believed.with_effect('payload', 'shank'),
            believed.with_effect('torque_bias', 'hip_joint'),
        )
    )  # fmt: skip
    assert len(loaded.unknowns) == len(alone.unknowns) + 4
    counts = [shared_unknowns(found, {}) for found in (alone, loaded, pulled)]
    # Rigidly fixed, both are one body: the four tell nothing that the link's could not. A torque
    # is no body's: its number is one more. Off by 2e-6 and 2e-5, as beliefs have a width.
    assert counts[1] - counts[0] == pytest.approx(0.0, abs=0.01)
    assert counts[2] - counts[0] == pytest.approx(1.0, abs=0.01)


def test_a_sound_robot_has_little_to_look_at(believed):
    train = data(believed.with_values(OFF), believed)
    found = scores(believed, train, candidates_for(believed, [Setup()]), {})
    # The bias of smoothing is no noise: a few laws gain by it, none by much.
    assert np.median(list(found.gains.values())) < SEEN
    assert max(found.fitted.values()) < 10 * SEEN
    assert not found.pushed


def test_torques_are_told_where_there_was_no_time_to_look(believed):
    true = believed.with_values(OFF).with_effect('torque_bias', 'thigh_joint', bias=0.5)
    deadline = Deadline()

    def end_at_first_look(what, done, total, best):
        if 'first look' in what:
            deadline.ask()

    found = diagnose(
        believed, [recorded(true, 4.0, seed) for seed in (1, 2)],
        Options(effects=('torque_bias', 'cogging_torque'), workers=0), end_at_first_look,
        deadline=deadline,
    ).unfinished  # fmt: skip
    label, nats = found.by_torques[0]
    assert label == 'torque_bias@thigh_joint'
    assert nats > SEEN
    assert f'Torques alone, without a simulation, speak for {label}' in found.text
    # Of the others torques say that there is nothing in them.
    assert 'torque_bias@hip_joint' not in found.not_tried


def test_records_are_followed_as_far_as_the_torques_are_right(believed):
    hanging = followed(believed, [recorded(believed, 6.0, 1)])[0]
    assert hanging.whole
    # On its head gravity lets errors grow, and a drive that is wrong leaves torques unexplained.
    upside_down = Setup(gravity=(0.0, 0.0, 1.0))
    weak = believed.with_effect('torque_bias', 'thigh_joint', bias=1.5)
    cuts = [
        len(followed(believed, [recorded(model, 6.0, 1, upside_down)])[0].cuts)
        for model in (believed, weak)
    ]
    assert 0 < cuts[0] < cuts[1]


def test_a_fit_that_will_not_come_below_what_is_beaten_is_broken_off(believed, monkeypatch):
    walked = []
    residuals = torque_error.residuals
    monkeypatch.setattr(
        torque_error, 'residuals', lambda *a: walked.append(1) or residuals(*a)
    )  # fmt: skip
    train = data(believed.with_values(OFF), believed)

    def fitted(beaten):
        walked.clear()
        (found,) = fits_by_torque([believed], train, beaten=beaten)
        return found, len(walked)

    patient, steps = fitted(np.inf)
    near, same = fitted(patient.deviance + 1.0)
    assert (near.values, same) == (patient.values, steps)
    far, fewer = fitted(patient.deviance - 1e4)
    assert fewer < steps
    assert far.deviance > patient.deviance


def test_what_strains_the_belief_is_fitted_afresh(believed):
    """A load on the last link, whose own numbers take it over first, far from their belief."""
    load = {'mass': 1.1, 'x': 0.01, 'y': 0.02, 'z': -0.2}
    train = data(believed.with_values(OFF).with_effect('payload', 'shank', **load), believed)
    alone = fit_by_torque(believed, train)
    assert alone.values['shank_mass'] > 1.5
    carrying = believed.with_effect('payload', 'shank', mass=0.5)
    found = fit_by_torque(carrying, train, at=alone.values)
    assert found.values['payload@shank.mass'] == pytest.approx(load['mass'], rel=0.25)
    assert (alone.deviance - found.deviance) / 2 > SEEN


PLAY = {'gap': 0.003, 'rotor_inertia': 0.4, 'stiffness': 19_000.0, 'damping': 50.0}


@pytest.mark.evidence
def test_a_fit_with_play_sets_out_from_torques():
    believed = Model.from_text(CART_POLE)
    machine = believed.with_values({'cart_mass': 1.02}).with_effect('backlash', **PLAY)
    data_sets = prepare(believed, [ride(machine, k) for k in range(2)])
    errors = []
    for start in starts_of(Backlash(believed.mechanism)):
        model = believed.with_effect('backlash', **start)
        errors.append(fit(model, data_sets).normalised_error)
    # Noise alone gives 1. By simulation alone the best of nine starts comes to 5.2, and half of
    # them stay above 50.
    assert np.median(errors) < 1.1


def test_what_nothing_drives_is_judged_alike_whatever_load_a_model_has():
    """A pole with a load has more inertia, and its acceleration is as wrong as before."""
    believed = Model.from_text(CART_POLE)
    load = {'mass': 0.17, 'x': 0.01, 'y': 0.0, 'z': -0.54}
    machine = believed.with_effect('payload', 'pole', **load)
    data_sets = prepare(believed, [ride(machine, k) for k in range(2)])
    plain = fit_by_torque(believed, data_sets)
    loaded = [believed.with_effect('payload', 'pole', mass=start) for start in (0.05, 0.5)]
    light, heavy = (fit_by_torque(model, data_sets) for model in loaded)
    assert light.deviance == pytest.approx(heavy.deviance, abs=1.0)
    assert (plain.deviance - light.deviance) / 2 > SEEN
    assert light.values['payload@pole.mass'] == pytest.approx(load['mass'], rel=0.2)
    # As it stands a model is judged in the same units as when it was fitted.
    standing = loaded[1].with_values(light.values)
    left = scale_of(all_rows(left_by(standing, data_sets)))
    np.testing.assert_allclose(left, light.scale, rtol=1e-6)


def test_what_nothing_drives_does_not_lose_its_weight():
    """All terms of a pole's equation grow with its mass: without one they would leave no error."""
    believed = Model.from_text(CART_POLE)
    machine = believed.with_values({'cart_mass': 1.02}).with_effect('backlash', **PLAY)
    data_sets = prepare(believed, [ride(machine, k) for k in range(2)])
    found = fit_by_torque(machine, data_sets).values
    assert found['pole_mass'] == pytest.approx(1.0, rel=0.03)
    assert found['backlash.rotor_inertia'] == pytest.approx(PLAY['rotor_inertia'], rel=0.03)
    assert found['backlash.gap'] == pytest.approx(PLAY['gap'], rel=0.2)  # the noise narrows it


@pytest.mark.parametrize(
    ('name', 'hidden'),
    [
        ('joint_flexibility', {'stiffness': 0.05, 'rotor_inertia': 2e-5, 'damping': 3e-4}),
        pytest.param(
            'backlash',
            {'gap': 0.02, 'rotor_inertia': 2e-5, 'stiffness': 3.0, 'damping': 5e-3},
            marks=pytest.mark.evidence,
        ),
        pytest.param(
            'backlash',
            {'gap': 0.008, 'rotor_inertia': 2e-5, 'stiffness': 3.0, 'damping': 5e-3},
            marks=pytest.mark.evidence,
        ),
    ],
)
def test_what_a_light_drive_hides_is_found_from_starts_of_its_size(name, hidden):
    """A finger turns 1/15 000 of what a leg does: a spring for that would be rigid here."""
    believed = finger.finger()
    machine = believed.with_values({'tip_mass': 1.06}).with_effect(name, **hidden)
    data_sets = finger.data(machine, 4)
    found = try_candidate(Task(believed, (name, None)), data_sets[:2], data_sets[2:])
    assert found.train.normalised_error < 1.1
    values = found.model.values
    size = 'stiffness' if name == 'joint_flexibility' else 'gap'
    assert values[f'{name}.{size}'] == pytest.approx(hidden[size], rel=0.05)


def test_a_start_whose_sensitivities_run_away_stays_where_it_is(believed, monkeypatch):
    data_sets = data(believed.with_values(OFF), believed)
    real, calls = torque_error.derivatives, []

    def run_away(*args):
        calls.append(args)
        slopes = real(*args)
        if len(calls) > 2:
            slopes[3, 1, 0] = np.inf
        return slopes

    monkeypatch.setattr(torque_error, 'derivatives', run_away)
    found = fit_by_torque(believed, data_sets)
    assert len(calls) == 3
    assert np.isfinite(found.deviance)
    assert all(np.isfinite(value) for value in found.values.values())


@pytest.mark.parametrize(
    ('name', 'hidden', 'ruled_out'),
    [
        ('coulomb_friction', {'torque': 1.1e-3}, True),
        pytest.param(
            'backlash',
            {'gap': 0.02, 'rotor_inertia': 2e-5, 'stiffness': 3.0, 'damping': 5e-3},
            False,
            marks=pytest.mark.evidence,
        ),
    ],
)
def test_a_rotor_is_not_simulated_where_torques_speak_clearly_for_a_rival(
    monkeypatch, name, hidden, ruled_out
):
    believed = finger.finger()
    machine = believed.with_values({'tip_mass': 1.06}).with_effect(name, **hidden)
    rival = Rival(believed.with_effect('coulomb_friction', None), {}, {})
    task = Task(believed, ('backlash', None), rival=rival)
    if ruled_out:
        monkeypatch.setattr(look, 'fit', None)
    found = look.screen(task, finger.data(machine, 2, 8.0))
    assert np.isinf(found.error) == ruled_out
    assert bool(found.task.warm_starts) != ruled_out


def test_likelihoods_are_compared_over_the_same_windows(believed):
    data_sets = data(believed.with_values(OFF), believed)
    rotor = believed.with_effect('joint_flexibility', 'shank_joint')
    long, short, followed = (
        sum(len(problem.motion.rate) for problem in problems_of(model, data_sets, (), quick))
        for model, quick in ((believed, False), (believed, True), (rotor, False))
    )
    assert long != short
    assert short == followed
