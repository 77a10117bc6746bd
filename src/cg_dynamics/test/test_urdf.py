"""A robot by its URDF: its numbers, its coordinates, and what is compiled of it."""

import pickle

import casadi as ca
import numpy as np
import pytest
from random_trees import random_tree

from cg_description.model_file import ModelFile
from cg_description.robot_description import RobotDescriptionError, parse, with_inertials
from cg_dynamics.assemble import assemble, parameter_vector
from cg_dynamics.effects import LIBRARY, make_effect
from cg_dynamics.effects.effect import START_TORQUE
from cg_dynamics.errors import ModelError
from cg_dynamics.mechanisms import mechanism
from cg_dynamics.mechanisms.urdf import Urdf, nearest_real
from cg_dynamics.model import Model
from cg_dynamics.rig import Setup
from cg_dynamics.rollout.compiled import CompiledModel, compile_model, simulate

PENDULUM = """<robot name="pendulum"><link name="base"/>
  <link name="rod"><inertial><origin xyz="0.02 0 -0.3"/><mass value="1.2"/>
    <inertia ixx="0.03" iyy="0.031" izz="0.002" ixy="0" ixz="0.001" iyz="0"/></inertial></link>
  <joint name="pivot" type="continuous"><parent link="base"/><child link="rod"/>
    <axis xyz="0 1 0"/></joint></robot>"""


def robot(text: str, **entries) -> Model:
    return Model.from_file(
        ModelFile(name='robot', mechanism='urdf', parameters={}, robot={'urdf': text, **entries})
    )


def nominal(body: Urdf) -> dict:
    return {p.name: p.default for p in body.parameters}


# --- numbers ---


def test_at_its_neutral_numbers_a_body_weighs_what_the_urdf_says():
    body = Urdf(parse(PENDULUM))
    found = body.inertials(nominal(body))['rod']
    given = parse(PENDULUM).inertials['rod']
    assert found.mass == pytest.approx(given.mass)
    assert found.centre == pytest.approx(given.centre)
    assert found.inertia == pytest.approx(given.inertia, abs=1e-12)


def test_whatever_the_numbers_real_bodies_have_them():
    random, body = np.random.default_rng(4), Urdf(parse(random_tree(3, 3)))
    for _ in range(200):
        numbers = {
            p.name: np.exp(random.normal(0, 1)) if p.logarithmic else random.normal(0, 2)
            for p in body.parameters
        }
        for inertial in body.inertials(numbers).values():
            xx, yy, zz, xy, xz, yz = inertial.inertia
            moments = np.linalg.eigvalsh([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]])
            assert inertial.mass > 0
            assert moments[0] > 0
            assert moments[2] < moments[0] + moments[1]


def test_every_real_body_has_numbers():
    # From one body to any other: mass, shift, then the Cholesky factors' quotient.
    body, other = (Urdf(parse(random_tree(seed, 1))) for seed in (21, 22))
    here, there = body._bodies[0], other._bodies[0]
    # x -> c + G D ...: any upper triangular D with S = G D D' G' does.
    quotient = np.linalg.solve(here.gyration, there.gyration)
    square = quotient @ quotient.T
    flipped = np.linalg.cholesky(square[::-1, ::-1])[::-1, ::-1]
    shift = np.linalg.solve(here.gyration, there.centre - here.centre)
    link = here.link
    numbers = {
        f'{link}_mass': there.mass / here.mass,
        **{f'{link}_shift_{a}': s for a, s in zip('xyz', shift, strict=True)},
        **{f'{link}_stretch_{a}': flipped[k, k] for k, a in enumerate('xyz')},
        f'{link}_shear_xy': flipped[0, 1],
        f'{link}_shear_xz': flipped[0, 2],
        f'{link}_shear_yz': flipped[1, 2],
    }
    found = body.inertials(nominal(body) | numbers)[link]
    expected = other.inertials(nominal(other))[there.link]
    assert found.mass == pytest.approx(expected.mass)
    assert found.centre == pytest.approx(expected.centre)
    assert found.inertia == pytest.approx(expected.inertia)


def test_welded_links_weigh_with_the_link_that_carries_them():
    welded = PENDULUM.replace('</robot>', """
      <link name="tool"><inertial><mass value="0.5"/><origin xyz="0.1 0 0"/>
        <inertia ixx="0.001" iyy="0.002" izz="0.0015" ixy="0" ixz="0" iyz="0"/></inertial></link>
      <joint name="weld" type="fixed"><parent link="rod"/><child link="tool"/>
        <origin xyz="0 0 -0.6" rpy="0 1.5707963267948966 0"/></joint></robot>""")  # fmt: skip
    body = Urdf(parse(welded))
    found = body.inertials(nominal(body))['rod']
    assert body.bodies == ('tool',)  # the tip names what hangs there
    assert found.mass == pytest.approx(1.7)
    # The tool's x axis points down the rod: its centre is 0.7 m below the pivot.
    tool = np.array([0, 0, -0.7])
    centre = (1.2 * np.array([0.02, 0, -0.3]) + 0.5 * tool) / 1.7
    assert found.centre == pytest.approx(centre)
    about = 0.031 + 1.2 * (0.02**2 + 0.3**2) + 0.002 + 0.5 * 0.7**2
    yy = found.inertia[1] + 1.7 * (centre[0] ** 2 + centre[2] ** 2)
    assert yy == pytest.approx(about)


def test_an_inertia_that_no_body_has_is_refused():
    with pytest.raises(ModelError, match=r"link 'rod': no body has the inertia.*0.002, 0.03, 0.9"):
        robot(PENDULUM.replace('iyy="0.031"', 'iyy="0.9"').replace('ixz="0.001"', 'ixz="0"'))


def test_the_nearest_inertia_that_a_body_has_keeps_the_largest_moment():
    """Second moments 0.4495, 0.4505 and, less than nothing, -0.4485 kg m^2 about turned axes."""
    turned = PENDULUM.replace(
        '<origin xyz="0.02 0 -0.3"/>', '<origin xyz="0.02 0 -0.3" rpy="1 2 3"/>'
    )
    unreal = turned.replace('iyy="0.031"', 'iyy="0.9"').replace('ixz="0.001"', 'ixz="0"')
    description, changed = nearest_real(parse(unreal))
    before, after = changed['rod']
    thin = 1.2 * 1e-6  # kg m^2, of a body that is a millimetre thin
    np.testing.assert_allclose(before, [0.002, 0.03, 0.9], rtol=1e-12)
    own = (0.9 + 0.002 - 0.03) / 2, (0.9 + 0.03 - 0.002) / 2
    np.testing.assert_allclose(after, [own[0] + thin, own[1] + thin, 0.9], rtol=1e-9)
    rod = Urdf(description).inertials(nominal(Urdf(description)))['rod']
    np.testing.assert_allclose(rod.inertia, description.inertials['rod'].inertia, rtol=1e-9)
    assert nearest_real(parse(turned)) == (parse(turned), {})


def test_what_weighs_on_no_joint_may_be_anything():
    weight = '<mass value="1"/><inertia ixx="1" iyy="1" izz="9" ixy="0" ixz="0" iyz="0"/>'
    base = f'<link name="base"><inertial>{weight}</inertial></link>'
    welded = PENDULUM.replace('<link name="base"/>', base)
    assert nearest_real(parse(welded))[1] == {}
    assert Urdf(parse(welded)).coordinates == ('pivot',)


def test_a_point_mass_gets_a_little_extent():
    point = PENDULUM.replace('ixx="0.03" iyy="0.031" izz="0.002" ixy="0" ixz="0.001"',
                             'ixx="0" iyy="0" izz="0" ixy="0" ixz="0"')  # fmt: skip
    body = Urdf(parse(point))
    assert max(body.inertials(nominal(body))['rod'].inertia) == pytest.approx(2 * 1.2e-6)


def test_numbers_that_no_motion_shows_are_left_alone():
    # About its own axis a body has an inertia, and two first moments that gravity pulls on.
    one = [p.name for p in Urdf(parse(PENDULUM)).parameters if p.free]
    assert len(one) == 3
    # About a vertical axis gravity pulls on nothing.
    upright = PENDULUM.replace('axis xyz="0 1 0"', 'axis xyz="0 0 1"')
    assert len([p for p in Urdf(parse(upright)).parameters if p.free]) == 1


def test_base_parameters_are_as_many_as_the_literature_says():
    # Six revolute joints, the first upright, the second and third parallel, an offset wrist: 36
    # [Gautier & Khalil 1990; also what is published for the UR10e].
    rows = [('z', '0 0 0.18'), ('y', '0 0.17 0'), ('y', '0.6 -0.13 0'), ('y', '0.57 0 0'),
            ('z', '0 0.17 0'), ('y', '0 0 0.12')]  # fmt: skip
    text, parent = '<robot name="arm"><link name="base"/>', 'base'
    for k, (axis, place) in enumerate(rows):
        vector = {'z': '0 0 1', 'y': '0 1 0'}[axis]
        text += (
            f'<link name="l{k}"><inertial><mass value="{3 - k / 3}"/>'
            f'<origin xyz="0.1 0.02 {0.05 + k / 100}"/><inertia ixx="0.03" iyy="0.04" izz="0.02" '
            f'ixy="0.001" ixz="0.002" iyz="0.003"/></inertial></link><joint name="j{k}" '
            f'type="revolute"><parent link="{parent}"/><child link="l{k}"/>'
            f'<origin xyz="{place}"/><axis xyz="{vector}"/></joint>'
        )
        parent = f'l{k}'
    body = Urdf(parse(text + '</robot>'))
    assert sum(p.free for p in body.parameters) == 36


def test_what_was_found_goes_back_into_the_urdf():
    body = Urdf(parse(random_tree(8, 3)))
    random = np.random.default_rng(1)
    numbers = nominal(body) | {p.name: p.default + random.normal(0, 0.1) for p in body.parameters
                               if p.belief}  # fmt: skip
    # The tree has welds: all that a body weighs stands in its own link then.
    description = body.description
    welded = {j.child: None for j in description.joints if j.kind == 'fixed'}
    text = description.text()
    plain = parse(with_inertials(text, body.inertials(numbers)))
    again = Urdf(parse(plain.text())) if not welded else None
    q, v, a = random.normal(size=(3, 3))
    if again is not None:
        taken = [
            np.asarray(ca.DM(b.inverse_dynamics(ca.SX(q), ca.SX(v), ca.SX(a), p, b.up(Setup()))))
            for b, p in ((body, numbers), (again, nominal(again)))
        ]
        np.testing.assert_allclose(*taken, rtol=1e-9)
    assert not welded  # else this test says nothing: choose another seed


# --- what moves ---


def test_channels_are_named_after_joints():
    model = robot(random_tree(8, 3), driven=['joint_0', 'joint_2'], rates=True)
    body = model.mechanism
    assert body.inputs == ('joint_0_effort', 'joint_2_effort')
    assert body.outputs[0] == 'joint_0_position'
    assert body.outputs[3] == 'joint_0_velocity'
    assert set(body.sensor_kinds.values()) == {'encoder', 'tachometer'}
    with pytest.raises(ModelError, match=r"driven: 'wheel' is no joint.*: joint_0, joint_2"):
        robot(random_tree(8, 3), driven=['wheel'])


def test_friction_acts_at_a_joint_without_a_drive_and_what_a_drive_does_acts_at_none():
    text, random = random_tree(8, 3), np.random.default_rng(2)
    every, some = robot(text), robot(text, driven=['joint_0'])
    x, found = random.normal(0, 1, 6), []
    for model in (every, some):
        acting = model.with_effect('viscous_friction', 'joint_2', coefficient=0.4)
        e = assemble(acting, Setup())
        rates = ca.Function('f', [e.x, e.u, e.p], [e.rates])
        u = np.zeros(len(model.mechanism.inputs))
        u[0] = 0.3
        found.append(np.asarray(rates(x, u, parameter_vector(acting, Setup()))))
    np.testing.assert_allclose(*found, rtol=1e-12)
    for name in ('torque_bias', 'rotor_inertia', 'load_dependent_friction', 'back_emf'):
        with pytest.raises(ModelError, match='not at'):
            some.with_effect(name, 'joint_2')


def test_what_a_drive_has_to_turn_sets_where_effects_set_out():
    """The rod about its pivot by Steiner, 0.031 + 1.2 (0.02^2 + 0.3^2); a slide moves masses."""
    rod = robot(PENDULUM).mechanism
    size = 0.031 + 1.2 * (0.02**2 + 0.3**2)
    assert rod.inertia_at('pivot') == pytest.approx(size, rel=1e-12)
    starts, scales = (
        {p.name: getattr(p, what) for p in LIBRARY['joint_flexibility'](rod).parameters}
        for what in ('starts', 'scale')
    )
    legs = {p.name: p for p in LIBRARY['joint_flexibility'].parameters}
    for name, p in legs.items():
        np.testing.assert_allclose(starts[name], size * np.array(p.starts), rtol=1e-12)
        assert scales[name] == pytest.approx(size * p.scale)
    (stiffness, *_) = LIBRARY['joint_flexibility'](rod).parameters
    ends = size * legs['stiffness'].lower, legs['stiffness'].upper
    assert (stiffness.lower, stiffness.upper) == pytest.approx(ends)
    # Times and shares are as they were; what torques lead needs no size.
    lag, friction = (LIBRARY[n](rod) for n in ('actuator_lag', 'coulomb_friction'))
    assert lag.parameters == LIBRARY['actuator_lag'].parameters
    assert friction.parameters[0].starts == LIBRARY['coulomb_friction'].parameters[0].starts
    limit = '<limit effort="1" velocity="1" lower="-1" upper="1"/>'
    text = PENDULUM.replace('continuous', 'prismatic').replace('<axis', f'{limit}<axis')
    slide = robot(text).mechanism
    assert slide.inertia_at('pivot') == pytest.approx(1.2, rel=1e-12)
    torques = [LIBRARY['joint_flexibility'](body).start_torque for body in (rod, slide)]
    assert torques == pytest.approx([START_TORQUE * size**0.8, START_TORQUE * 1.2])
    # Where another joint moves what a joint carries, the mean over its poses lies between.
    arm = robot(random_tree(5, 2)).mechanism
    poses = np.random.default_rng(1).uniform(-3, 3, (200, 2))
    q = ca.SX.sym('q', 2)
    matrix = ca.Function('m', [q], [arm.mass_matrix(q, nominal(arm))])
    own = [np.asarray(matrix(pose))[0, 0] for pose in poses]
    assert min(own) < arm.inertia_at(arm.coordinates[0]) < max(own)


def test_a_heavy_joint_may_rub_and_push_more():
    """A lift of 122 kg with 20 kN s/m of damping, as PR2 states of its torso."""
    limit = '<limit effort="10000" velocity="0.01" lower="0" upper="0.3"/>'
    lift = PENDULUM.replace('continuous', 'prismatic').replace('value="1.2"', 'value="122"')
    model = robot(lift.replace('<axis', f'{limit}<axis'))
    model = model.with_effect('viscous_friction', coefficient=20000.0)
    assert model.declarations['viscous_friction.coefficient'].upper == pytest.approx(122_000)
    legs = LIBRARY['viscous_friction'].parameters[0]
    light = LIBRARY['viscous_friction'](robot(PENDULUM).mechanism).parameters[0]
    assert light == legs  # ranges become wider only


def test_equal_robots_are_one():
    a, b, other = (Urdf(parse(random_tree(seed, 2))) for seed in (3, 3, 4))
    assert a == b
    assert hash(a) == hash(b)
    assert a != other
    assert a.identity != Urdf(parse(random_tree(3, 2)), rates=True).identity
    there, again = (pickle.loads(pickle.dumps(a)) for _ in range(2))
    assert there == a
    assert again is there  # what follows from a URDF is worked out once a process


def test_a_model_reads_back_from_its_own_text():
    model = robot(random_tree(5, 3), driven=['joint_1'])
    model = model.with_effect('viscous_friction', 'joint_1', coefficient=0.3)
    model = model.with_values({'link_1_mass': 1.1})
    again = Model.from_text(model.text())
    assert again.values == model.values
    assert again.mechanism == model.mechanism
    assert again.hash == model.hash
    assert 'link_2_mass' not in model.text()  # what is as in the URDF stays there


WRIST = {'motor_a': {'joint_1': 1.0, 'joint_2': 1.0}, 'motor_b': {'joint_1': 1.0, 'joint_2': -1.0}}


def test_motors_that_share_joints_are_places_with_or_without_a_torque_of_their_own():
    text = random_tree(5, 3, slide=0.0)
    told = robot(text, couplings=WRIST)  # the joints' torques are known
    for name in ('rotor_inertia', 'coulomb_friction'):
        assert {*WRIST, 'joint_0'} <= {*LIBRARY[name].sites(told.mechanism)}
    assert not {*WRIST} & {*LIBRARY['torque_constant'].sites(told.mechanism)}
    driven = robot(text, couplings=WRIST, driven=['joint_0', *WRIST])
    assert LIBRARY['torque_constant'].sites(driven.mechanism) == ('joint_0', *WRIST)
    assert 'joint_1' in LIBRARY['coulomb_friction'].sites(driven.mechanism)
    again = Model.from_text(driven.with_effect('coulomb_friction', 'motor_b', torque=0.2).text())
    assert again.mechanism == driven.mechanism != told.mechanism
    assert pickle.loads(pickle.dumps(driven.mechanism)) == driven.mechanism


def test_a_motor_turns_what_its_joints_carry_seen_through_the_ratios():
    body = Urdf(parse(random_tree(5, 3, slide=0.0)), couplings={
        'motor_a': {'joint_1': 2.0, 'joint_2': 2.0}, 'motor_b': {'joint_1': 1.0, 'joint_2': 1.0},
    })  # fmt: skip
    assert body.inertia_at('motor_a') == pytest.approx(body.inertia_at('motor_b') / 4)
    assert not body.slides('motor_a')


@pytest.mark.parametrize(
    ('couplings', 'said'),
    [
        ({'joint_0': {'joint_1': 1.0, 'joint_2': 1.0}}, 'a joint has that name'),
        ({'motor': {'joint_1': 1.0, 'elbow': 1.0}}, "'elbow' is no joint that moves by itself"),
        ({'motor': {'joint_1': 1.0, 'joint_2': 0.0}}, 'two joints at least'),
        ({'motor': {'joint_1': 1.0}}, 'two joints at least'),
    ],
)
def test_a_coupling_that_is_none_is_named(couplings, said):
    with pytest.raises(ModelError, match=rf'couplings\.\w+: .*{said}'):
        robot(random_tree(5, 3), couplings=couplings)


def test_a_urdf_needs_its_robot_and_no_other_has_one():
    with pytest.raises(ModelError, match="'urdf' needs an entry 'robot'"):
        mechanism('urdf')
    with pytest.raises(ModelError, match="'robot' belongs to the mechanism urdf, not to 'pendul"):
        mechanism('pendulum', {'urdf': PENDULUM})
    with pytest.raises(ModelError, match=r'robot\.urdf: no XML'):
        mechanism('urdf', {'urdf': 'x'})


def test_locked_joints_stand_where_they_are_held():
    model = robot(random_tree(6, 4, slide=0))
    _, second, _, fourth = model.mechanism.coordinates
    held = Setup.from_dict({'locked': {second: 0.7, fourth: -0.4}})
    free, locked = assemble(model, Setup()), assemble(model, held)
    assert locked.coordinates == 2
    random = np.random.default_rng(2)
    s, ds, u = random.normal(size=2), random.normal(size=2), random.normal(size=4)
    p = parameter_vector(model, held)
    f = ca.Function('f', [locked.x, locked.u, locked.p], [locked.rates, locked.outputs])
    rates, outputs = (np.asarray(r).ravel() for r in f(np.r_[s, ds], u, p))
    np.testing.assert_allclose(outputs, [s[0], 0.7, s[1], -0.4])
    # The same motion of the free robot takes these torques at the joints that move.
    take = ca.Function('g', [free.x, free.u, free.p, free.acceleration], [free.imbalance])
    x = np.r_[s[0], 0.7, s[1], -0.4, ds[0], 0, ds[1], 0]
    balance = np.asarray(take(x, u, p, [rates[2], 0, rates[3], 0])).ravel()
    np.testing.assert_allclose(balance[[0, 2]], 0, atol=1e-9)
    assert held.to_dict()['locked'] == {second: 0.7, fourth: -0.4}
    with pytest.raises(ModelError, match=r"setup\.locked: 'knee' is no joint"):
        assemble(model, Setup(locked=(('knee', 0.0),)))


@pytest.mark.parametrize('seed', [2, 3, 9, 11])
def test_a_robot_with_joints_held_moves_as_the_whole_one_that_keeps_them_still(seed):
    """Five joints and one that follows the first: three of them, one that slides, are held."""
    text = random_tree(seed, 6, mimic=True, slide=0.4)
    whole = Urdf(parse(text))
    random = np.random.default_rng(seed)
    held = {name: float(random.uniform(-2, 2)) for name in whole.coordinates[::2]}
    part = Urdf(parse(text).holding(held))
    assert part.coordinates == whole.coordinates[1::2]
    numbers = [{p.name: ca.SX(p.default) for p in body.parameters} for body in (whole, part)]
    q, v, a = random.normal(size=(3, len(part.coordinates)))
    places = [whole.coordinates.index(name) for name in part.coordinates]
    at = np.array([held.get(name, 0.0) for name in whole.coordinates])
    at[places] = q
    rates, accelerations = np.zeros((2, len(at)))
    rates[places], accelerations[places] = v, a
    up = whole.up(Setup())
    expected, found = (
        np.asarray(ca.DM(body.inverse_dynamics(*map(ca.SX, motion), p, up))).ravel()
        for body, motion, p in (
            (whole, (at, rates, accelerations), numbers[0]), (part, (q, v, a), numbers[1]),
        )
    )  # fmt: skip
    # Angles go into a matrix and back, with sixteen digits.
    np.testing.assert_allclose(found, expected[places], rtol=0, atol=1e-12 * abs(expected).max())


def test_who_holds_a_joint_names_one_that_moves_by_itself():
    with pytest.raises(RobotDescriptionError, match=r"'joint_5' is no joint that moves by itself"):
        parse(random_tree(2, 6, mimic=True)).holding({'joint_5': 0.1})


def test_what_is_compiled_is_of_the_set_up():
    model = robot(random_tree(6, 3, slide=0))
    first = model.mechanism.coordinates[0]
    time, u, start = np.arange(0, 0.1, 0.002), np.zeros((50, 3)), np.zeros(4)
    ends = [
        simulate(model, setup, time, u, start)[1][-1]
        for setup in (
            Setup(locked=((first, 0.5),)), Setup(locked=((first, -0.5),)),
            Setup(locked=((first, 0.5),), gravity=(0.0, 1.0, 0.0)),
        )
    ]  # fmt: skip
    assert [end[0] for end in ends] == [0.5, -0.5, 0.5]
    assert not np.allclose(ends[0][1:], ends[1][1:])
    assert not np.allclose(ends[0][1:], ends[2][1:])


def test_gravity_comes_from_the_set_up():
    # Mounted on a wall: what hung along -z hangs along +x.
    model = robot(PENDULUM)
    sideways = Setup.from_dict({'gravity': [9.81, 0, 0]})
    lean = np.arctan2(0.3, 0.02)  # of the centre of mass in the rod's frame, about y
    for setup, rest in ((Setup(), lean - np.pi / 2), (sideways, lean - np.pi)):
        e = assemble(model, setup)
        f = ca.Function('f', [e.x, e.u, e.p], [e.rates])
        at_rest = f([-rest, 0], [0], parameter_vector(model, setup))
        np.testing.assert_allclose(np.asarray(at_rest), 0, atol=1e-9)
    assert Setup().to_dict() == Setup.from_dict(Setup().to_dict()).to_dict()
    assert 'gravity' not in Setup().to_dict()


@pytest.mark.parametrize(('seed', 'joints'), [(1, 1), (4, 3), (7, 6)])
def test_energy_stays_where_nothing_takes_it(seed, joints):
    model = robot(random_tree(seed, joints, slide=0))
    start = np.r_[np.random.default_rng(seed).uniform(-1, 1, joints), np.zeros(joints)]
    time = np.arange(0, 1.0, 0.001)
    states, _ = simulate(model, Setup(), time, np.zeros((len(time), joints)), start)
    e = assemble(model, Setup())
    energy = ca.Function('energy', [e.x, e.p], [e.energy])
    values = np.asarray(energy(states.T, parameter_vector(model, Setup()))).ravel()
    p = parameter_vector(model, Setup())
    still = np.vstack([states[:, :joints].T, np.zeros((joints, len(states)))])
    moved = np.ptp(np.asarray(energy(still, p)))
    # Runge-Kutta of fourth order at 1 ms; the potential energy moves by `moved`.
    assert moved > 0.1
    assert np.ptp(values) < 1e-6 * moved


@pytest.mark.parametrize('native', [True, False])
def test_sensitivities_are_the_derivatives_of_what_is_simulated(native):
    model = robot(random_tree(9, 3))
    for joint in model.mechanism.driven:
        model = model.with_effect('viscous_friction', joint, coefficient=0.4)
    compiled = compile_model(model, Setup())
    if not native:
        compiled = CompiledModel(compiled.equations, compiled.free, native=False)
    p, random = parameter_vector(model, Setup()), np.random.default_rng(5)
    time = np.arange(0, 0.4, 0.002)
    u = random.normal(0, 2, (len(time), 3))
    x0 = np.r_[random.normal(0, 0.5, 3), random.normal(0, 1, 3)]
    columns = 6 + len(compiled.free)
    s0 = np.hstack([np.eye(6), np.zeros((6, columns - 6))])
    y = compiled.readings(time, u, x0, p)
    _, _, jacobian = compiled.normal(
        time, u, x0, s0, p, np.arange(6, columns), y, np.ones(3), keep=True
    )
    step = 1e-5
    for column in range(columns):
        ends = []
        for sign in (1, -1):
            x, values = x0.copy(), p.copy()
            if column < 6:
                x[column] += sign * step
            else:
                place = compiled.parameter_names.index(compiled.free[column - 6])
                values[place] += sign * step
            ends.append(compiled.readings(time, u, x, values))
        difference = (ends[0] - ends[1]) / (2 * step)
        # Central differences of step 1e-5 lose half of the digits.
        np.testing.assert_allclose(
            jacobian[:, :, column], difference, atol=2e-7 * (1 + np.abs(difference).max())
        )


# --- effects ---


def equations(model, setup=Setup()):  # noqa: B008 - immutable
    e = assemble(model, setup)
    return ca.Function('f', [e.x, e.u, e.p], [e.rates]), parameter_vector(model, setup)


def test_places_are_named_by_the_urdf():
    model = robot(random_tree(8, 3)).with_effect('coulomb_friction', 'joint_0', torque=0.2)
    assert model.effects[0].label == 'coulomb_friction@joint_0'
    assert robot(PENDULUM).with_effect('coulomb_friction').effects[0].label == 'coulomb_friction'


def test_a_payload_is_as_a_welded_link():
    # A point mass of 0.4 kg, once as an effect and once as a link of the URDF.
    place = (0.1, -0.05, 0.2)
    text = random_tree(8, 3)
    welded = text.replace('</robot>', f"""<link name="load"><inertial><mass value="0.4"/>
      <inertia ixx="0" iyy="0" izz="0" ixy="0" ixz="0" iyz="0"/></inertial></link>
      <joint name="tie" type="fixed"><parent link="link_2"/><child link="load"/>
      <origin xyz="{place[0]} {place[1]} {place[2]}"/></joint></robot>""")  # fmt: skip
    x, y, z = place
    carrying, p = equations(robot(text).with_effect('payload', 'link_2', mass=0.4, x=x, y=y, z=z))
    heavier, p0 = equations(robot(welded))
    random = np.random.default_rng(3)
    for _ in range(5):
        motion, u = random.normal(size=6), random.normal(size=3)
        # The point is 1 mm large there: relative to its distance squared 2e-5.
        np.testing.assert_allclose(carrying(motion, u, p), heavier(motion, u, p0), rtol=1e-4)


@pytest.mark.parametrize('link', ['link_1', 'link_2', 'tip'])
def test_a_load_takes_power_as_its_energies_say(link):
    # Recursion carries the load; its energies are derived from where it is. Without friction the
    # power of the drives is all that changes their sum with those of the robot.
    tip = """<link name="tip"/><joint name="tie" type="fixed"><parent link="link_3"/>
      <child link="tip"/><origin xyz="0.1 -0.3 0.2" rpy="0.4 -0.7 1.1"/></joint></robot>"""
    bare = robot(random_tree(8, 3).replace('</robot>', tip))
    carrying = bare.with_effect('payload', link, mass=0.7, x=0.3, y=-0.2, z=0.1)
    e, without = assemble(carrying, Setup()), assemble(bare, Setup())
    power = ca.jtimes(e.energy, e.x, e.rates) - ca.dot(e.u, e.x[3:6])
    f = ca.Function('power', [e.x, e.u, e.p], [power, e.energy])
    energy = ca.Function('energy', [without.x, without.p], [without.energy])
    p, p0 = (parameter_vector(model, Setup()) for model in (carrying, bare))
    random = np.random.default_rng(5)
    for _ in range(5):
        motion, u = random.normal(size=6), random.normal(size=3)
        unaccounted, all_of_it = map(float, f(motion, u, p))
        # Rounding of some hundred terms of the size of the energy.
        assert abs(unaccounted) < 1e-9 * (1 + abs(all_of_it))
        assert abs(all_of_it - float(energy(motion, p0))) > 1e-3


def test_a_tilted_base_is_as_tilted_gravity():
    model = robot(random_tree(8, 3))
    tilted, p = equations(model.with_effect('ground_slope', x=0.03, y=-0.05))
    cx, sx, cy, sy = np.cos(0.03), np.sin(0.03), np.cos(-0.05), np.sin(-0.05)
    # In the frame of a base that was turned about x and then about y, up is:
    about_x, about_y = (
        [[1, 0, 0], [0, cx, sx], [0, -sx, cx]],
        [[cy, 0, -sy], [0, 1, 0], [sy, 0, cy]],
    )
    up = np.array(about_y) @ about_x @ [0, 0, 1]
    leaning, p0 = equations(model, Setup(gravity=tuple(-up)))
    motion, u = np.random.default_rng(4).normal(size=6), np.zeros(3)
    np.testing.assert_allclose(tilted(motion, u, p), leaning(motion, u, p0), rtol=1e-9)


def test_a_push_on_a_link_gives_momentum_to_what_carries_it():
    """In no gravity the momenta M dq/dt become its impulses, and those of no other joint.

    That more of it comes later shows in when they grow: the first moment of what acts is the
    growth times the variance of the pulse over its standard deviation.
    """
    text = random_tree(8, 4)
    body = robot(text).mechanism
    link = next(b for b in body.bodies if 1 < len(body.joints_to(b)) < 4)
    carriers = body.joints_to(link)
    impulses = {name: 1e-3 * (k + 1) * (-1) ** k for k, name in enumerate(carriers)}
    growths = {name: 7e-4 * (k + 1) for k, name in enumerate(carriers[:-1])}
    model = robot(text).with_values({'gravity': 0.0}).with_effect(
        'external_push', link, instant=0.06, duration=0.01,
        **{f'impulse_{name}': value for name, value in impulses.items()},
        **{f'growth_{name}': value for name, value in growths.items()},
    )  # fmt: skip
    units = {p.name: p.unit for p in model.effects[0].parameters}
    assert all(
        units[f'impulse_{name}'] == ('N s' if body.slides(name) else 'N m s') for name in carriers
    )
    time = np.arange(0, 0.12, 0.001)
    u = np.column_stack([np.zeros((len(time), 4)), time])
    motion = np.concatenate([np.random.default_rng(3).normal(size=4), np.zeros(4)])
    states, _ = simulate(model, Setup(), time, u, motion)
    q, p = ca.SX.sym('q', 4), ca.SX.sym('p', len(body.parameters))
    named = dict(zip((x.name for x in body.parameters), ca.vertsplit(p), strict=True))
    mass = ca.Function('mass', [q, p], [body.mass_matrix(q, named)])
    numbers = list(nominal(body).values())
    momenta = np.array([np.asarray(mass(x[:4], numbers)) @ x[4:8] for x in states])
    expected = [impulses.get(name, 0.0) for name in body.coordinates]
    # What the motion itself changes is of second order: rates are below 0.1.
    np.testing.assert_allclose(momenta[-1], expected, atol=2e-5)
    middles = (time[1:] + time[:-1]) / 2 - 0.06
    moments = middles @ np.diff(momenta, axis=0)
    expected = [0.01 * growths.get(name, 0.0) for name in body.coordinates]
    np.testing.assert_allclose(moments, expected, atol=2e-5 * 0.06)


@pytest.mark.parametrize('name', sorted(LIBRARY))
def test_every_effect_acts_wherever_it_says_it_can(name):
    model = robot(random_tree(8, 2), driven=['joint_0'])
    kind = LIBRARY[name]
    applies = kind.applies([Setup()]) or name == 'position_control'  # which nobody seeks
    for site in kind.sites(model.mechanism) if applies else ():
        parameters = kind(model.mechanism, site).parameters
        values = {p.name: p.starts[0] for p in parameters if p.starts}
        f, p = equations(model.with_effect(name, site, **values))
        x = np.random.default_rng(1).normal(0, 0.1, f.size1_in(0))
        assert np.isfinite(np.asarray(f(x, np.ones(f.size1_in(1)), p))).all()


def test_loads_are_sought_from_what_a_link_weighs():
    """From the link's own centre, or from the origin of a tip, which is on no joint's axis."""
    inertia = '<inertia ixx="0.01" iyy="0.02" izz="0.02" ixy="0" ixz="0" iyz="0"/>'
    link = '<link name="{}"><inertial><mass value="{}"/><origin xyz="{}"/>' + inertia
    text = (
        '<robot name="arm"><link name="base"/>'
        + link.format('upper', 2.0, '0.1 0.02 -0.3') + '</inertial></link>'
        + link.format('lower', 0.5, '0.2 0 0') + '</inertial></link>'
        + link.format('hand', 0.3, '0 0 0.05') + '</inertial></link>'
        '<joint name="shoulder" type="continuous"><parent link="base"/><child link="upper"/>'
        '<axis xyz="0 1 0"/></joint>'
        '<joint name="elbow" type="continuous"><parent link="upper"/><child link="lower"/>'
        '<origin xyz="0 0 -0.6"/><axis xyz="0 1 0"/></joint>'
        '<joint name="wrist" type="fixed"><parent link="lower"/><child link="hand"/>'
        '<origin xyz="0.4 0 0"/></joint></robot>'
    )  # fmt: skip
    body = Urdf(parse(text))
    mass, *place = make_effect('payload', body, 'upper').parameters
    assert mass.starts == pytest.approx((0.6, 2.0))
    assert [p.starts for p in place] == [(0.1,), (0.02,), (-0.3,)]
    mass, *place = make_effect('payload', body, 'hand').parameters
    assert mass.starts == pytest.approx((0.24, 0.8))
    assert [p.starts for p in place] == [(0.0,), (0.0,), (0.0,)]
