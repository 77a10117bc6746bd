"""Which laws the torques of a robot lack, told without a simulation."""

import json

import numpy as np
import pytest
from hanging_arm import nominal, recorded
from slide import CART_POLE, ride

from cg_dynamics.model import Model
from cg_dynamics.rig import Setup
from cg_sysid.cli.torques import main
from cg_sysid.diagnosis.diagnose import Options, diagnose
from cg_sysid.identification.data_set import prepare
from cg_sysid.identification.joint_friction import friction_of
from cg_sysid.identification.torque_error import fit_by_torque
from cg_sysid.identification.unknowns import IdentificationError
from cg_sysid.parallel import one_by_one
from cg_sysid.records.bags import write_bag
from cg_sysid.search import torque_search
from cg_sysid.search.torque_alternatives import with_likes
from cg_sysid.search.torque_judging import Judge
from cg_sysid.search.torque_screening import scores
from cg_sysid.search.torque_search import TorqueSearch
from cg_sysid.search.torque_selection import select

OFF = {
    'thigh_mass': 1.12, 'shank_mass': 0.9, 'coulomb_friction@hip_joint.torque': 0.3,
    'viscous_friction@shank_joint.coefficient': 0.16, 'coulomb_friction@thigh_joint.torque': 0.11,
}  # fmt: skip
STRIBECK = ('stribeck_friction', 'thigh_joint', {'torque': 0.3, 'stribeck_rate': 0.4})
RIPPLE = ('cogging_torque', 'hip_joint', {'amplitude': 0.2, 'cycles': 12.0, 'phase': 0.7})
SECONDS = 6.0
FREE = (Setup(),) * 4
SHANK = Setup(locked=(('shank_joint', 0.3),))
LEG = Setup(locked=(('hip_joint', -0.2), ('thigh_joint', 0.4)))


@pytest.fixture(scope='module')
def believed():
    return nominal()


def machine(believed, *hidden):
    true = believed.with_values(OFF)
    for name, at, sizes in hidden:
        known = {p.name for p in true.with_effect(name, at).effects[-1].parameters}
        assert set(sizes) <= known
        true = true.with_effect(name, at, **sizes)
    return true


def ways(machine, believed, setups=FREE):
    found = prepare(believed, [recorded(machine, SECONDS, k, s) for k, s in enumerate(setups)])
    return found[0::2], found[1::2]


def test_two_laws_of_two_joints_are_taken_up_with_their_sizes(believed):
    train, held = ways(machine(believed, STRIBECK, RIPPLE), believed)
    found = select(believed, train, held)
    assert {law.label for law in found.laws} == {
        'stribeck_friction@thigh_joint', 'cogging_torque@hip_joint'
    }  # fmt: skip
    sizes = {law.label: law.parameters for law in found.laws}
    # Biased by smoothing, as all torque fits are.
    value, sigma, unit = sizes['cogging_torque@hip_joint']['amplitude']
    assert value == pytest.approx(0.2, abs=0.02)
    assert 0 < sigma < 0.02
    assert unit == 'N m'
    value, sigma, _ = sizes['stribeck_friction@thigh_joint']['torque']
    assert value == pytest.approx(0.3, rel=0.05)
    assert 0 < sigma < 0.02
    hip, thigh, _ = range(3)
    assert found.coordinates == ('hip_joint', 'thigh_joint', 'shank_joint')
    assert found.identified[hip] < found.stated[hip]
    for k in (hip, thigh):
        assert found.extended[k] < 0.9 * found.identified[k]
    assert {e.label for e in found.model.effects} > set(sizes)


@pytest.mark.evidence
def test_what_all_joints_lack_is_taken_up_at_once(believed, monkeypatch):
    """Dry friction and rotors, of which the file says nothing; each joint hides the others'."""
    bare, hidden = believed, []
    for joint, inertia in zip(believed.mechanism.driven, (0.09, 0.06, 0.03), strict=True):
        bare = bare.without_effect(f'coulomb_friction@{joint}')
        hidden.append(('rotor_inertia', joint, {'inertia': inertia}))
    looks = []
    monkeypatch.setattr(
        torque_search, 'scores', lambda *a, **k: looks.append(a) or scores(*a, **k)
    )
    found = select(bare, *ways(machine(believed, *hidden), bare))
    sizes = {law.label: next(iter(law.parameters.values()))[0] for law in found.laws}
    true = {
        'coulomb_friction@hip_joint': 0.3, 'coulomb_friction@thigh_joint': 0.11,
        'coulomb_friction@shank_joint': 0.1, 'rotor_inertia@hip_joint': 0.09,
        'rotor_inertia@thigh_joint': 0.06, 'rotor_inertia@shank_joint': 0.03,
    }  # fmt: skip
    assert sizes.keys() == true.keys()
    for label, size in true.items():
        assert sizes[label] == pytest.approx(size, rel=0.1), label
    assert len(looks) == 3  # one for each kind, and one that finds nothing more


def test_a_stribeck_curve_is_told_where_dry_friction_seems_to_stay():
    """All that fades grows again as viscous friction does."""
    dry, viscous, fading, rate = 1.0, 3.0, 3.0, 0.3
    # Of a slide whose file knows no friction.
    bare = Model.from_text(CART_POLE).without_effect('viscous_friction@slide')
    true = bare.with_effect('coulomb_friction', 'slide', torque=dry)
    true = true.with_effect('viscous_friction', 'slide', coefficient=viscous)
    true = true.with_effect('stribeck_friction', 'slide', torque=fading, stribeck_rate=rate)
    data_sets = prepare(bare, [ride(true, k) for k in range(4)])
    shapes = ('coulomb', 'viscous', 'quadratic', 'stribeck')
    asked_for = [f'{shape}_friction@slide' for shape in shapes]
    found = select(bare, data_sets[0::2], data_sets[1::2], asked_for)
    sizes = {law.label: [value for value, _, _ in law.parameters.values()] for law in found.laws}
    # Biased by smoothing, as all torque fits are.
    assert sizes == {
        'coulomb_friction@slide': pytest.approx([dry], rel=0.05),
        'viscous_friction@slide': pytest.approx([viscous], rel=0.05),
        'stribeck_friction@slide': pytest.approx([fading, rate], rel=0.05),
    }
    alone = select(bare, data_sets[0::2], data_sets[1::2], asked_for[:3])
    assert 'stribeck_friction@slide' not in {law.label for law in alone.laws}


def selected_of_rides(bare, true, names):
    data_sets = prepare(bare, [ride(true, k) for k in range(4)])
    found = select(bare, data_sets[0::2], data_sets[1::2], names)
    return {law.label: [value for value, _, _ in law.parameters.values()] for law in found.laws}


def test_two_are_taken_up_at_once_where_neither_is_worth_it_alone():
    """What a slope leaves is constant, so that nothing in it is independent."""
    bare = Model.from_text(CART_POLE).without_effect('viscous_friction@slide')
    true = bare.with_effect('viscous_friction', 'slide', coefficient=3.0)
    true = true.with_effect('coulomb_friction', 'slide', torque=0.6)
    true = true.with_effect('ground_slope', x=0.0, y=0.012)
    sizes = selected_of_rides(
        bare, true, ['viscous_friction', 'coulomb_friction', 'ground_slope']
    )  # fmt: skip
    _, about_y = sizes.pop('ground_slope')  # nothing on a rail along x turns about x
    assert about_y == pytest.approx(0.012, rel=0.05)
    assert sizes == {
        'viscous_friction@slide': pytest.approx([3.0], rel=0.02),
        'coulomb_friction@slide': pytest.approx([0.6], rel=0.02),
    }


def test_friction_one_way_only_is_a_constant_beside_friction_both_ways():
    bare = Model.from_text(CART_POLE).without_effect('viscous_friction@slide')
    true = bare.with_effect('coulomb_friction', 'slide', torque=0.6)
    true = true.with_effect('torque_bias', bias=-0.6)
    names = ['coulomb_friction', 'viscous_friction', 'asymmetric_friction', 'torque_bias']
    assert selected_of_rides(bare, true, names) == {
        'coulomb_friction@slide': pytest.approx([0.6], rel=0.02),
        'torque_bias': pytest.approx([-0.6], rel=0.02),
    }


def test_a_joint_whose_friction_is_of_another_kind_than_the_others_has_that():
    """Dry friction is taken up at all joints at once; what little a pivot has fits both."""
    bare = Model.from_text(CART_POLE)
    for joint in 'slide', 'pivot':
        bare = bare.without_effect(f'viscous_friction@{joint}')
    true = bare.with_effect('coulomb_friction', 'slide', torque=1.5)
    true = true.with_effect('viscous_friction', 'pivot', coefficient=0.001)
    assert selected_of_rides(bare, true, ['coulomb_friction', 'viscous_friction']) == {
        'coulomb_friction@slide': pytest.approx([1.5], rel=0.02),
        'viscous_friction@pivot': pytest.approx([0.001], rel=0.2),  # noise: 10 %
    }


@pytest.mark.parametrize('label', ['coulomb_friction@slide', 'friction_drift@slide'])
def test_friction_that_fades_for_minutes_gives_way_to_friction_that_stays(label):
    bare = Model.from_text(CART_POLE)
    drift = {'excess': 0.6, 'time_constant': 2.0}
    sizes = {'coulomb_friction': {'torque': 0.6}, 'friction_drift': drift}
    name, at = label.split('@')
    data_sets = prepare(bare, [ride(bare.with_effect(name, at, **sizes[name]), k) for k in (0, 1)])
    judge = Judge(data_sets[:1], data_sets[1:])
    search = TorqueSearch(judge, ['coulomb_friction', 'friction_drift'], one_by_one)
    start = {'friction_drift@slide.time_constant': 100.0} if name != 'friction_drift' else {}
    base = judge.fit(bare.with_effect('friction_drift', at, **drift), start)
    none = judge.fit(bare, {})
    drifts = judge.law(none, base, 'friction_drift@slide', base.independent())
    found = with_likes(search, base, [drifts])
    if label == 'friction_drift@slide':
        assert found is None
    else:
        ((law,), fitted) = found
        assert law.label == label
        assert fitted.said.values[f'{label}.torque'] == pytest.approx(0.6, rel=0.02)


def test_of_laws_that_leave_the_same_the_simplest_is_taken_up(believed):
    # A drift that takes minutes and a friction that fades at a rate never reached are this one.
    true = believed.with_values(OFF | {'coulomb_friction@shank_joint.torque': 0.5})
    smooth = believed.without_effect('coulomb_friction@shank_joint')
    (law,) = select(smooth, *ways(true, smooth)).laws
    assert law.label == 'coulomb_friction@shank_joint'
    assert law.parameters['torque'][0] == pytest.approx(0.5, rel=0.05)


@pytest.mark.parametrize('seed', [1, pytest.param(2, marks=pytest.mark.evidence)])
def test_a_sound_arm_has_none(believed, seed):
    records = [recorded(machine(believed), SECONDS, 10 * seed + k) for k in range(4)]
    data_sets = prepare(believed, records)
    found = select(believed, data_sets[0::2], data_sets[1::2])
    assert not found.laws
    assert np.array_equal(found.identified, found.extended)


def test_only_those_asked_for_are_taken_up(believed):
    train, held = ways(machine(believed, RIPPLE), believed)
    assert not select(believed, train, held, ['torque_bias']).laws
    (law,) = select(believed, train, held, ['cogging_torque@hip_joint', 'payload']).laws
    assert law.label == 'cogging_torque@hip_joint'


@pytest.mark.evidence
def test_recordings_with_different_joints_locked_go_together(believed):
    setups = (SHANK, SHANK, LEG, LEG)
    true = machine(believed, STRIBECK)
    train, held = ways(true, believed, setups)
    plain = fit_by_torque(believed, train)
    # Of the joints that only some recordings move, what those say.
    assert plain.values['viscous_friction@shank_joint.coefficient'] == pytest.approx(0.16, rel=0.1)
    assert plain.values['coulomb_friction@hip_joint.torque'] == pytest.approx(0.3, rel=0.1)
    (law,) = select(believed, train, held).laws
    assert law.label == 'stribeck_friction@thigh_joint'
    # A joint that is locked in all of them has no torque error.
    alone = fit_by_torque(believed, train[:1])
    assert list(np.isnan(alone.relative)) == [False, False, True]


def test_a_diagnosis_takes_them_together_too(believed):
    setups = (SHANK, SHANK, LEG, LEG)
    true = machine(believed, STRIBECK)
    records = [recorded(true, 4.0, k, setup) for k, setup in enumerate(setups)]
    found = diagnose(believed, records, Options(effects=('stribeck_friction',)))
    assert [cause.label for cause in found.causes] == ['stribeck_friction@thigh_joint']
    value, sigma, _ = found.causes[0].parameters['torque']
    assert value == pytest.approx(0.3, abs=max(4 * sigma, 1e-3))
    assert found.extended.held.normalised_error < 1.3


def test_a_mechanism_with_equations_of_its_own_is_no_robot_of_a_urdf():
    model = Model.load('compass_gait_mit')
    with pytest.raises(IdentificationError, match='robot of a URDF with an encoder'):
        select(model, [], [])


def test_from_bags_to_the_model_with_its_laws(believed, tmp_path, capsys):
    true = machine(believed, RIPPLE)
    bags = [str(write_bag(tmp_path / f'way_{k}', recorded(true, SECONDS, k))) for k in range(3)]
    believed.save(tmp_path / 'leg.yaml')
    out = tmp_path / 'answer'
    command = ['--model', str(tmp_path / 'leg.yaml'), '--out', str(out), '--workers', '1']
    assert main([*command, '--held', 'way_1', *bags]) == 0
    facts = json.loads((out / 'torques.json').read_text())
    assert facts['format'] == 'cg_torques/1'
    assert facts['held'] == ['way_1']
    assert facts['train'] == ['way_0', 'way_2']
    assert [law['label'] for law in facts['laws']] == ['cogging_torque@hip_joint']
    assert facts['joints']['hip_joint']['extended'] < facts['joints']['hip_joint']['identified']
    extended = Model.load(out / 'model.yaml')
    assert extended.values['cogging_torque@hip_joint.amplitude'] == pytest.approx(0.2, abs=0.02)
    assert (out / 'friction.png').read_bytes().startswith(b'\x89PNG')
    said = capsys.readouterr().out
    assert 'cogging torque (hip joint): amplitude = 0.20' in said
    assert f'cg diagnose --model {out / "model.yaml"}' in said


def test_what_opposes_a_joint_is_its_friction(believed):
    true = machine(believed, STRIBECK)
    data_sets = ways(true, believed)[0]
    thigh = friction_of(true, data_sets)['thigh_joint']
    moving = np.abs(thigh.rate) > 0.3  # where friction turns within a window it is off
    p = true.values
    law = p['viscous_friction@thigh_joint.coefficient'] * thigh.rate
    law += np.sign(thigh.rate) * p['coulomb_friction@thigh_joint.torque']
    law += (
        np.sign(thigh.rate)
        * p['stribeck_friction@thigh_joint.torque']
        * np.exp(-((thigh.rate / p['stribeck_friction@thigh_joint.stribeck_rate']) ** 2))
    )
    # Smoothing over 0.12 s bends it, and the drive's torque of some 3 N m leaves a little.
    assert np.median(np.abs(thigh.measured - law)[moving]) < 0.03
    assert np.median(np.abs(thigh.modelled - law)[moving]) < 0.02
    locked = prepare(believed, [recorded(true, SECONDS, 1, SHANK)])
    assert set(friction_of(true, locked)) == {'hip_joint', 'thigh_joint'}


def test_one_recording_is_halved(believed, tmp_path):
    bag = write_bag(tmp_path / 'way', recorded(machine(believed, RIPPLE), 2 * SECONDS, 1))
    believed.save(tmp_path / 'leg.yaml')
    out = tmp_path / 'answer'
    command = ['--model', str(tmp_path / 'leg.yaml'), '--out', str(out), '--workers', '1']
    assert main([*command, '--effects', 'cogging_torque', str(bag)]) == 0
    facts = json.loads((out / 'torques.json').read_text())
    assert [law['label'] for law in facts['laws']] == ['cogging_torque@hip_joint']
    assert len(facts['train']) == len(facts['held']) == 1
    assert facts['train'] != facts['held']


@pytest.mark.parametrize(
    ('options', 'message'),
    [
        (['--effects', 'sensor_delay,backlash'], 'torques alone cannot tell of sensor_delay'),
        (['--effects', 'magic'], "no effect 'magic'"),
        (['--held', 'nothing*'], 'matches no record'),
        (['--workers', '-1'], 'must not be negative'),
    ],
)
def test_a_wrong_option_is_named(believed, tmp_path, capsys, options, message):
    bag = str(write_bag(tmp_path / 'way', recorded(believed, 1.0, 1)))
    believed.save(tmp_path / 'leg.yaml')
    command = ['--model', str(tmp_path / 'leg.yaml'), '--out', str(tmp_path / 'answer')]
    assert main([*command, *options, bag]) == 2
    assert message in capsys.readouterr().err
