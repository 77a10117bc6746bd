"""Models: round trip through the file, and one clear error for each thing that can be wrong."""

import pickle
from copy import deepcopy
from dataclasses import replace

import numpy as np
import pytest
import yaml

from cg_description.model_file import sha256
from cg_description.paths import model_path
from cg_dynamics.assemble import parameter_names, parameter_vector
from cg_dynamics.effects import LIBRARY
from cg_dynamics.mechanisms import MECHANISMS
from cg_dynamics.model import Model, ModelError, ModelFileError
from cg_dynamics.rig import Setup


def edited(robot, path, value):
    """The text of the model file with one entry changed, or taken out if value is None."""
    tree = yaml.safe_load(robot.text())
    node = tree
    for key in path[:-1]:
        node = node[key]
    if value is None:
        del node[path[-1]]
    else:
        node[path[-1]] = value
    return yaml.safe_dump(tree)


def test_text_reads_back_to_an_equal_model(robot):
    again = Model.from_text(robot.text())
    assert again.text() == robot.text()
    assert again.hash == robot.hash
    assert again.quantities == robot.quantities


@pytest.mark.parametrize(
    'name', [n for n, e in LIBRARY.items() if e.sites(MECHANISMS['compass_gait'])]
)
def test_every_effect_survives_the_file(robot, name):
    sites = LIBRARY[name].sites(robot.mechanism)
    model = (
        robot
        if name in ('viscous_friction', 'coulomb_friction')
        else robot.with_effect(name, at=sites[-1])
    )
    again = Model.from_text(model.text())
    assert [e.label for e in again.effects] == [e.label for e in model.effects]
    assert again.values == model.values


def test_what_a_model_is_made_of_cannot_be_written_to(robot):
    """The hash is computed once: nothing that it stands for may change behind its back."""
    quantities, entries = dict(robot.quantities), {'links': {'a': 1}}
    model = replace(robot, quantities=quantities, provenance=entries)
    before = model.hash
    quantities['c1'] = replace(quantities['c1'], value=0.5)
    entries['links']['a'] = 2
    assert model.hash == before == sha256(model.text())
    for mapping in (model.quantities, model.sensors, model.actuators, model.provenance):
        with pytest.raises(TypeError):
            mapping['c1'] = None
    with pytest.raises(TypeError):
        next(iter(model.actuators.values()))['limit'] = None
    assert model.with_values({'c1': 0.11}).hash != before


def test_model_travels_between_processes(robot):
    robot.hash  # noqa: B018  what was computed must not stay behind as something else
    there = pickle.loads(pickle.dumps(robot))
    assert there.quantities == robot.quantities
    assert there.hash == sha256(there.text()) == robot.hash
    assert deepcopy(robot).text() == robot.text()


def test_file_is_saved_whole(robot, tmp_path):
    path = tmp_path / 'deeper' / 'model.yaml'
    robot.save(path)
    assert Model.load(path).hash == robot.hash
    assert [p.name for p in path.parent.iterdir()] == ['model.yaml']


@pytest.mark.parametrize(
    ('path', 'value', 'message'),
    [
        (('parameters', 'c1', 'unit'), 'kg', "parameters.c1.unit: 'kg' is not '1'"),
        (('parameters', 'c1'), None, r'parameters.c1 \(1, inner legs.*missing'),
        (('parameters', 'c1', 'value'), 9.0, r'c1 = 9 1 is outside its range \[1e-05, 2\]'),
        (('parameters', 'c9'), {'value': 1, 'unit': '1'}, "unknown entry 'c9'; allowed: leg_len"),
        (('parameters', 'c4', 'value'), 0.9, 'no real bodies have these parameters: condition 4'),
        (('parameters', 'c3', 'value'), 0.102, 'no real bodies.*condition 1'),
        (('mechanism',), 'unicycle', "unknown mechanism 'unicycle'; there are: compass_gait"),
        (('effects', 0, 'name'), 'magic', "unknown effect 'magic'; the library has: actuator_"),
        (('effects', 0, 'name'), 'viqcous_friction', "did you mean 'viscous_friction'"),
        (('effects', 0, 'name'), 'm' * 100, "unknown effect 'm{40}…'; the library has: actuator_"),
        (('effects', 0, 'at'), 'knee', "acts at hip of a compass_gait, not at 'knee'"),
        (
            ('effects', 0, 'parameters', 'coefficient', 'unit'), 'N m',
            r"effects\[0\].parameters.coefficient.unit: 'N m' is not 'N m s/rad'",
        ),
        (
            ('effects', 0, 'parameters', 'coefficient', 'value'), -1.0,
            r'effects\[0\].parameters.coefficient = -1 N m s/rad is outside its range',
        ),
        (
            ('effects', 0, 'parameters', 'colour'), {'value': 1, 'unit': '1'},
            r"effects\[0\].parameters: unknown entry 'colour'; allowed: coefficient",
        ),
        (('sensors', 'sonar'), {}, "sensors: unknown entry 'sonar'; allowed: imu_angle"),
        (('sensors', 'imu_angle', 'noise', 'unit'), 'deg', "noise.unit: 'deg' is not 'rad'"),
        (('sensors', 'imu_angle', 'noise', 'value'), -1.0, 'noise.value: -1 is not allowed'),
        (('sensors', 'hip_angle', 'resolution', 'value'), 0.0, 'resolution.value: 0 is not allow'),
        (('actuators', 'hip_torque', 'limit', 'value'), 0.0, 'limit.value: 0 is not allowed'),
        (('effects', 1, 'name'), 'coulomb_fricton', "did you mean 'coulomb_friction'"),
        (('sensors', 'imu_angle', 'smell'), {'value': 1, 'unit': '1'}, "unknown entry 'smell'"),
        (('actuators', 'knee_torque'), {}, "actuators: unknown entry 'knee_torque'"),
    ],
)  # fmt: skip
def test_wrong_entry_is_named_with_what_is_allowed(robot, path, value, message):
    with pytest.raises((ModelError, ModelFileError), match=message) as caught:
        Model.from_text(edited(robot, path, value), 'robot.yaml')
    assert 'robot.yaml' in str(caught.value)


def test_effect_listed_twice_is_refused(robot):
    tree = yaml.safe_load(robot.text())
    tree['effects'].append(tree['effects'][0])
    with pytest.raises(ModelError, match="'viscous_friction' is listed twice"):
        Model.from_text(yaml.safe_dump(tree))


def test_effect_parameters_left_out_take_their_defaults(robot):
    tree = yaml.safe_load(robot.text())
    del tree['effects'][1]['parameters']['transition_rate']
    assert Model.from_text(yaml.safe_dump(tree)).values['coulomb_friction.transition_rate'] == 0.01


def test_a_shape_as_it_always_is_stays_out_of_the_file_and_its_hash(robot):
    """So a law may get another shape, and trees and bags still know the model."""
    usual = {'coulomb_friction.slow_share': 0.0, 'coulomb_friction.slow_rate': 0.01,
             'coulomb_friction.slow_tails': 0.0}  # fmt: skip
    assert 'slow' not in robot.text()
    assert 'transition_rate' in robot.text()  # simulators differ in it
    shaped = robot.with_values({'coulomb_friction.slow_share': 0.4,
                                'coulomb_friction.slow_rate': 0.02,
                                'coulomb_friction.slow_tails': 0.3})  # fmt: skip
    again = Model.from_text(shaped.text())
    assert (again.values['coulomb_friction.slow_rate'], again.hash) == (0.02, shaped.hash)
    assert shaped.hash != robot.hash
    assert again.with_values(usual).hash == robot.hash


def test_changes_return_new_models(robot):
    changed = robot.with_values({'c1': 0.11})
    assert (robot.values['c1'], changed.values['c1']) == (0.1007, 0.11)
    assert changed.quantities['c1'].source == robot.quantities['c1'].source
    with_one = robot.with_effect('payload', at='outer', mass=1.0)
    assert with_one.effect('payload@outer').site == 'outer'
    assert with_one.without_effect('payload@outer').values == robot.values


def test_label_names_the_place_only_where_it_is_not_the_usual_one(robot):
    assert robot.with_effect('payload', at='inner').effects[-1].label == 'payload'
    assert robot.with_effect('payload', at='outer').effects[-1].label == 'payload@outer'
    both = robot.with_effect('payload', at='inner').with_effect('payload', at='outer')
    assert both.without_effect('payload').effects[-1].label == 'payload@outer'


def test_unknown_names_list_what_there_is(robot):
    with pytest.raises(ModelError, match="unknown entry 'c7'; allowed: leg_length"):
        robot.with_values({'c7': 1.0})
    with pytest.raises(ModelError, match="no effect 'payload'; it has: viscous_friction, coul"):
        robot.effect('payload')
    with pytest.raises(ModelError, match="already has the effect 'viscous_friction'"):
        robot.with_effect('viscous_friction')


def test_parameter_vector_follows_the_names(robot, springs):
    setup = Setup(springs=springs)
    model = robot.with_effect('payload')
    names, vector = parameter_names(model, setup), parameter_vector(model, setup)
    found = dict(zip(names, vector, strict=True))
    assert found['payload.mass'] == 0.05
    assert found['spring1.anchor_x'] == 0.7
    assert found['coulomb_friction.torque'] == 1.84


def test_smallest_stated_torque_limit_holds(robot):
    assert robot.torque_limit == 40.0


def lumps_of(bodies):
    (m1, d1, i1), (m2, d2, i2), (m3, d3, i3), extra = bodies
    mt = m1 + m2 + m3 + extra
    c3 = (i3 + m3 * d3**2) / (4 * mt)
    return {
        'c1': (i1 + m1 * d1**2) / mt + c3, 'c2': (i2 + m2 * d2**2) / mt + c3, 'c3': c3,
        'c4': m1 * d1 / mt, 'c5': m2 * d2 / mt, 'c6': m3 * d3 / (4 * mt),
    }  # fmt: skip


def test_lumps_of_real_bodies_are_consistent(rng):
    """Masses, places and inertias at random, leg length 1: LUMPS holds of all of them."""
    body = MECHANISMS['compass_gait']
    for _ in range(500):
        bodies = [tuple(rng.uniform([0.1, -0.5, 1e-4], [5, 1, 0.2])) for _ in '123']
        assert min(body.consistency(lumps_of([*bodies, rng.uniform(0, 5)]))) > 0


def test_consistent_lumps_have_real_bodies(rng):
    """The converse, by building the bodies: the proof in theory.md, LUMPS."""
    body = MECHANISMS['compass_gait']
    tried = 0
    while tried < 200:
        c = dict(zip(('c1', 'c2', 'c3', 'c4', 'c5', 'c6'), rng.uniform(-0.3, 0.5, 6), strict=True))
        conditions = body.consistency(c)
        if min(conditions) <= 0:
            continue
        tried += 1
        slack = conditions[-1]
        inertias = (c['c1'] - c['c3'], c['c2'] - c['c3'], 4 * c['c3'])
        moments = (c['c4'], c['c5'], 4 * c['c6'])
        masses = [mu**2 / i + slack / 4 for mu, i in zip(moments, inertias, strict=True)]
        own = [i - mu**2 / m for i, mu, m in zip(inertias, moments, masses, strict=True)]
        bodies = [(m, mu / m, i) for m, mu, i in zip(masses, moments, own, strict=True)]
        assert min(masses) > 0
        assert min(own) >= -1e-15
        again = lumps_of([*bodies, 1 - sum(masses)])
        assert sum(masses) < 1
        for name, value in c.items():
            np.testing.assert_allclose(again[name], value, atol=1e-12)


@pytest.mark.parametrize('lump', ['c1', 'c2'])
def test_lumps_whose_conditions_divide_by_zero_are_refused_by_name(lump):
    model = Model.load(model_path('compass_gait_mit'))
    equal = model.with_values({lump: model.values['c3']})
    with pytest.raises(ModelError, match='no real bodies have these parameters'):
        equal.require_consistency()
