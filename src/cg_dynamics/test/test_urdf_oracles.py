"""Trees of joints in three engines: our recursion, MuJoCo and Drake, from the same URDF text."""

import casadi as ca
import numpy as np
import pytest
from random_trees import random_tree

from cg_description.model_file import ModelFile
from cg_description.robot_description import parse
from cg_dynamics.assemble import assemble, parameter_vector
from cg_dynamics.mechanisms.urdf import Urdf
from cg_dynamics.model import Model
from cg_dynamics.rig import Setup

# Of the largest entry. MuJoCo turns inertias into principal axes and angles into quaternions and
# back, which costs a few digits of the sixteen; Drake does not, but adds up in another order.
SAME = 1e-9
ROBOTS = [(seed, joints) for seed, joints in enumerate([1, 1, 2, 2, 3, 4, 5, 6, 7, 7])]


def ours(text, gravity=9.81):
    """M, bias and forward dynamics of a tree, as functions of numbers."""
    body = Urdf(parse(text))
    n = len(body.coordinates)
    p = {q.name: ca.SX(q.default) for q in body.parameters} | {'gravity': ca.SX(gravity)}
    q, v, a = (ca.SX.sym(name, n) for name in 'qva')
    mass = body.mass_matrix(q, p)
    bias = body.inverse_dynamics(q, v, ca.SX.zeros(n), p, body.up(Setup()))
    taken = body.inverse_dynamics(q, v, a, p, body.up(Setup()))
    return body, ca.Function('f', [q, v, a], [mass, bias, taken])


def motion(seed, n):
    random = np.random.default_rng([seed, 17])
    return random.uniform(-3, 3, n), random.normal(0, 2, n), random.normal(0, 4, n)


def close(found, expected):
    expected = np.asarray(expected)
    np.testing.assert_allclose(found, expected, rtol=0, atol=SAME * np.abs(expected).max())


@pytest.mark.parametrize(('seed', 'joints'), ROBOTS)
def test_mass_matrix_bias_and_acceleration_as_in_mujoco(seed, joints):
    mujoco = pytest.importorskip('mujoco', reason='MuJoCo is not installed')
    text = random_tree(seed, joints)
    body, f = ours(text)
    extension = '<mujoco><compiler fusestatic="false" discardvisual="true"/></mujoco>'
    engine = mujoco.MjModel.from_xml_string(text.replace('</robot>', f'{extension}</robot>'))
    engine.opt.disableflags |= int(mujoco.mjtDisableBit.mjDSBL_CONTACT)
    engine.opt.disableflags |= int(mujoco.mjtDisableBit.mjDSBL_LIMIT)
    data = mujoco.MjData(engine)
    place = [engine.joint(name).dofadr[0] for name in body.coordinates]
    q, v, torque = motion(seed, len(place))
    data.qpos[place], data.qvel[place], data.qfrc_applied[place] = q, v, torque
    mujoco.mj_forward(engine, data)
    full = np.zeros((engine.nv, engine.nv))
    for column, unit in zip(full, np.eye(engine.nv), strict=True):  # M is symmetric
        mujoco.mj_mulM(engine, data, column, unit)
    mass, bias, _ = map(np.asarray, f(q, v, np.zeros(len(q))))
    close(mass, full[np.ix_(place, place)])
    close(bias.ravel(), data.qfrc_bias[place])
    acceleration = data.qacc[place]
    # What a wrong digit of M or b does to an acceleration depends on M's condition.
    close(np.asarray(f(q, v, acceleration)[2]).ravel(), torque)


@pytest.mark.parametrize(('seed', 'joints'), ROBOTS)
def test_mass_matrix_bias_and_torques_as_in_drake(seed, joints):
    drake = pytest.importorskip('pydrake.all', reason='Drake is not installed')
    text = random_tree(seed, joints)
    body, f = ours(text)
    plant = drake.MultibodyPlant(0.0)
    (tree,) = drake.Parser(plant).AddModelsFromString(text, 'urdf')
    plant.WeldFrames(plant.world_frame(), plant.GetFrameByName('base'))
    plant.Finalize()
    context = plant.CreateDefaultContext()
    place = [plant.GetJointByName(name, tree).velocity_start() for name in body.coordinates]
    q, v, a = motion(seed, len(place))
    there = [np.zeros(len(place)) for _ in range(3)]
    for full, given in zip(there, (q, v, a), strict=True):
        full[place] = given
    plant.SetPositions(context, there[0])
    plant.SetVelocities(context, there[1])
    gravity = plant.CalcGravityGeneralizedForces(context)
    mass, bias, taken = map(np.asarray, f(q, v, a))
    close(mass, plant.CalcMassMatrix(context)[np.ix_(place, place)])
    close(bias.ravel(), (plant.CalcBiasTerm(context) - gravity)[place])
    forces = drake.MultibodyForces(plant)
    plant.CalcForceElementsContribution(context, forces)
    close(taken.ravel(), plant.CalcInverseDynamics(context, there[2], forces)[place])


def test_a_joint_that_follows_another_obeys_the_chain_rule():
    # Engines couple such joints by stiff constraints, so the tree without the coupling is the
    # oracle: it agrees with them above.
    text, loose = (random_tree(5, 4, mimic=follows) for follows in (True, False))
    body, f = ours(text)
    _, g = ours(loose)
    q, v, a = motion(5, 3)
    follow = np.vstack([np.eye(3), [-0.7, 0.0, 0.0]])
    order = [int(name[-1]) for name in body.coordinates]
    assert order == [0, 1, 2]
    full = follow @ q + np.array([0, 0, 0, 0.2])
    mass, bias, taken = map(np.asarray, f(q, v, a))
    apart = [np.asarray(x) for x in g(full, follow @ v, follow @ a)]
    np.testing.assert_allclose(mass, follow.T @ apart[0] @ follow, rtol=1e-12, atol=1e-12)
    np.testing.assert_allclose(bias, follow.T @ apart[1], rtol=1e-12, atol=1e-12)
    np.testing.assert_allclose(taken, follow.T @ apart[2], rtol=1e-12, atol=1e-12)


# A motor that two joints share is what MuJoCo calls a fixed tendon: joints weighted and added up,
# with an inertia and a damping of its own. Its mass matrix has no place for the inertia of a
# tendon between two branches, so these trees have both joints on one.
COUPLED = {
    'motor_a': {'joint_0': 1.3, 'joint_2': 0.8},
    'motor_b': {'joint_0': 1.1, 'joint_2': -2.0},
}
ROTORS, DAMPINGS, TORQUES = (0.37, 0.11), (0.9, 0.25), (4.0, -2.5)


@pytest.mark.parametrize('seed', [3, 4, 8])
def test_motors_of_a_differential_are_as_fixed_tendons_in_mujoco(seed):
    mujoco = pytest.importorskip('mujoco', reason='MuJoCo is not installed')
    text = random_tree(seed, 4)
    spec = mujoco.MjSpec.from_string(text.replace(
        '</robot>',
        '<mujoco><compiler fusestatic="false" discardvisual="true"/></mujoco></robot>',
    ))  # fmt: skip
    for joint in spec.joints:
        joint.limited = mujoco.mjtLimited.mjLIMITED_FALSE
    spec.option.disableflags |= int(mujoco.mjtDisableBit.mjDSBL_CONTACT)
    for (name, ratios), inertia, damping in zip(COUPLED.items(), ROTORS, DAMPINGS, strict=True):
        tendon = spec.add_tendon(name=name, armature=inertia, damping=[damping, 0, 0])
        for joint, ratio in ratios.items():
            tendon.wrap_joint(joint, ratio)
        motor = spec.add_actuator(name=name, target=name)
        motor.trntype = mujoco.mjtTrn.mjTRN_TENDON
        motor.gainprm[0] = 1.0
    engine = spec.compile()
    data = mujoco.MjData(engine)
    model = Model.from_file(ModelFile(
        name='tree', mechanism='urdf', parameters={},
        robot={'urdf': text, 'driven': list(COUPLED), 'couplings': COUPLED},
    ))  # fmt: skip
    for name, inertia, damping in zip(COUPLED, ROTORS, DAMPINGS, strict=True):
        model = model.with_effect('rotor_inertia', name, inertia=inertia)
        model = model.with_effect('viscous_friction', name, coefficient=damping)
    body = model.mechanism
    assert body.inputs == ('motor_a_effort', 'motor_b_effort')
    assert body.input_units == ('N m', 'N m')
    place = [engine.joint(name).dofadr[0] for name in body.coordinates]
    q, v, _ = motion(seed, 4)
    data.qpos[place], data.qvel[place], data.ctrl[:] = q, v, TORQUES
    mujoco.mj_forward(engine, data)
    e = assemble(model, Setup())
    rates = ca.Function('f', [e.x, e.u, e.p], [e.rates])
    found = rates([*q, *v], TORQUES, parameter_vector(model, Setup()))
    close(np.asarray(found).ravel()[4:], data.qacc[place])
