"""The same motions in two engines that share nothing with this package: Drake and MuJoCo.

The hip body bisects the legs, which neither engine can express as a plain joint; here it is as
good as massless, and test_compass_gait.py checks its terms against the thesis.
"""

import importlib

import numpy as np
import pytest

from cg_dynamics.rig import Setup
from cg_dynamics.rollout.compiled import simulate

TIME = np.arange(0, 1.0, 0.002)
TORQUE = np.repeat(np.random.default_rng(3).normal(0, 3, 50), 10)
TORQUE[:5] = 0  # a transmission that starts wound up would start differently in the engines
START = np.array([0.05, 0.1, 0.2, -0.3])


@pytest.fixture
def links(bare):
    """Two links."""
    return bare.with_values({'c3': 1e-7, 'c6': 0.0})


@pytest.fixture(scope='module')
def engine():
    pytest.importorskip('mujoco', reason='MuJoCo is not installed')
    return importlib.import_module('mujoco_robot')


@pytest.fixture
def drake():
    return pytest.importorskip('pydrake.all', reason='Drake is not installed')


# --- compass gait in MuJoCo ---------------------------------------------------------------------


def compare_with_mujoco(engine, links, model, setup, hidden, start=START):
    found = engine.simulate_mujoco(links.values, setup, TORQUE, 0.002, start, hidden)
    _, outputs = simulate(model, setup, TIME, TORQUE[:, None], start)
    # Steps of 2 ms here, 0.25 ms there, and c3 = 1e-7 where the engine has none.
    for j, (channel, tolerance) in enumerate(
        [('imu_angle', 5e-6), ('imu_rate', 3e-5), ('hip_angle', 5e-6)]
    ):
        np.testing.assert_allclose(found[channel], outputs[:, j], atol=tolerance, err_msg=channel)


@pytest.mark.parametrize('stance', ['inner', 'outer'])
def test_free_fall_of_the_stance_leg(engine, links, stance):
    compare_with_mujoco(engine, links, links, Setup(stance=stance), engine.Hidden())


@pytest.mark.parametrize(
    'fixture', [('inner', 'inner_fixed'), ('outer', 'outer_fixed'), ('inner', 'legs_tied')]
)
def test_fixtures(engine, links, fixture):
    setup = Setup(stance=fixture[0], fixture=fixture[1])
    compare_with_mujoco(engine, links, links, setup, engine.Hidden(), np.array([0.1, -0.3]))


@pytest.mark.parametrize('stance', ['inner', 'outer'])
def test_springs(engine, links, springs, stance):
    setup = Setup(stance=stance, springs=springs)
    compare_with_mujoco(engine, links, links, setup, engine.Hidden())


def test_every_hidden_effect(engine, links, springs):
    Hidden, leg_length = engine.Hidden, links.values['leg_length']
    cases = [
        *(
            (
                'payload', {'at': leg, 'mass': 1.0, 'distance': 0.4},
                Hidden(payload=(leg, 1.0, 0.4)),
            )
            for leg in ('inner', 'outer')
        ),
        ('viscous_friction', {'coefficient': 0.7}, Hidden(viscous=0.7)),
        ('coulomb_friction', {'torque': 1.8}, Hidden(coulomb=1.8)),
        (
            'quadratic_friction', {'coefficient': 0.4},
            Hidden(at_hip=lambda t, angle, w, torque: -0.4 * w * abs(w)),
        ),
        ('ground_slope', {'angle': 0.05}, Hidden(slope=0.05)),
        (
            'aerodynamic_drag', {'coefficient': 0.6},
            Hidden(on_leg=lambda w: -0.6 * w * abs(w)),
        ),
        (
            'ankle_friction', {'coefficient': 0.6},
            Hidden(at_stance=lambda t, angle, w: -0.6 * w),
        ),
        (
            'tether_force', {'force': 2.0},
            Hidden(at_stance=lambda t, angle, w: 2.0 * leg_length * np.cos(angle)),
        ),
        ('spring_damping', {'coefficient': 0.8}, Hidden(spring_damping=0.8)),
        (
            'cogging_torque', {'amplitude': 0.5, 'cycles': 12.0, 'phase': 0.7},
            Hidden(at_hip=lambda t, angle, w, torque: 0.5 * np.sin(12.0 * angle + 0.7)),
        ),
        (
            'load_dependent_friction', {'coefficient': 0.1},
            Hidden(at_hip=lambda t, angle, w, torque: -0.1 * abs(torque) * np.tanh(w / 0.01)),
        ),
        (
            'joint_flexibility', {'stiffness': 300.0, 'rotor_inertia': 0.1, 'damping': 0.5},
            Hidden(flexibility=(300.0, 0.1, 0.5)),
        ),
        ('actuator_delay', {'delay': 0.006}, Hidden(torque_delay=0.006)),
        ('sensor_delay', {'delay': 0.0031}, Hidden(sensor_delay=0.0031)),
        ('torque_constant', {'error': 0.07}, Hidden(torque_gain=1.07)),
        ('torque_bias', {'bias': 0.4}, Hidden(torque_bias=0.4)),
        ('imu_offset', {'offset': 0.01}, Hidden(offsets={'imu_angle': 0.01})),
    ]  # fmt: skip
    for name, values, hidden in cases:
        model = links.with_effect(name, **values)
        compare_with_mujoco(engine, links, model, Setup(springs=springs), hidden)


@pytest.mark.parametrize('share', [0.0, 0.6, 1.0])
def test_friction_on_both_sides_of_a_flexible_drive(engine, links, springs, share):
    model = (
        links.with_effect('viscous_friction', coefficient=0.7)
        .with_effect('coulomb_friction', torque=1.8)
        .with_effect(
            'motor_side_friction', stiffness=300.0, rotor_inertia=0.1, damping=0.5, share=share
        )
    )  # fmt: skip
    hidden = engine.Hidden(
        viscous=0.7, coulomb=1.8, flexibility=(300.0, 0.1, 0.5), motor_share=share
    )
    # From rest: there the rotor starts wound up by nothing, here by the friction on it.
    start = np.array([0.05, 0.1, 0.0, 0.0])
    compare_with_mujoco(engine, links, model, Setup(springs=springs), hidden, start)


# --- compass gait, pendulum and double pendulum in Drake ----------------------------------------


class DrakeChain:
    """Planar links joined by hinges about +y; link k hangs from link k-1.

    Args:
        drake: The module.
        links: (mass, centre of mass along the link, inertia about it, place of the next joint)
            of each link; places along the link's own z axis, which points up at angle 0.
        gravity: In m/s^2.
        forces: (link, place, world anchor (x, z), stiffness, free length) of springs.
    """

    def __init__(self, drake, links, gravity, springs=()):
        builder = drake.DiagramBuilder()
        plant = drake.MultibodyPlant(0.0)
        plant.mutable_gravity_field().set_gravity_vector([0, 0, -gravity])
        parent, place = plant.world_body(), 0.0
        self.joints, self.bodies = [], []
        for k, (mass, centre, inertia, following) in enumerate(links):
            spatial = drake.SpatialInertia.MakeFromCentralInertia(
                mass, [0, 0, centre], drake.RotationalInertia(inertia, inertia, inertia)
            )
            body = plant.AddRigidBody(f'link{k}', spatial)
            joint = plant.AddJoint(
                drake.RevoluteJoint(
                    f'joint{k}',
                    plant.AddFrame(
                        drake.FixedOffsetFrame(
                            f'end{k}', parent.body_frame(), drake.RigidTransform([0, 0, place])
                        )
                    ),
                    body.body_frame(),
                    [0, 1, 0],
                )
            )
            self.joints.append(joint)
            self.bodies.append(body)
            plant.AddJointActuator(f'actuator{k}', joint)
            parent, place = body, following
        for link, along, (x, z), stiffness, free_length in springs:
            plant.AddForceElement(
                drake.LinearSpringDamper(
                    plant.world_body(), [x, 0, z], self.bodies[link], [0, 0, along],
                    free_length, stiffness, 0.0,
                )
            )  # fmt: skip
        plant.Finalize()
        self.plant = builder.AddSystem(plant)
        self.drake = drake
        self.diagram = builder.Build()

    def simulate(self, q, v, torques, dt):
        """(q, v) of the joints at each row, torques (n, joints) held."""
        simulator = self.drake.Simulator(self.diagram)
        self.drake.ResetIntegratorFromFlags(simulator, 'runge_kutta5', dt)
        simulator.get_mutable_integrator().set_target_accuracy(1e-10)
        context = self.plant.GetMyMutableContextFromRoot(simulator.get_mutable_context())
        self.plant.SetPositionsAndVelocities(context, [*q, *v])
        rows = [[*q, *v]]
        for k, torque in enumerate(torques[:-1]):
            self.plant.get_actuation_input_port().FixValue(context, torque)
            simulator.AdvanceTo((k + 1) * dt)
            rows.append(self.plant.GetPositionsAndVelocities(context).copy())
        return np.array(rows)


def leg_bodies(engine_free_values):
    """(mass, place below the hip, inertia) of each leg and the hip mass, with these lumps."""
    v = engine_free_values
    l, mt = v['leg_length'], v['total_mass']
    legs, rest = [], mt
    for c, moment in (('c1', 'c4'), ('c2', 'c5')):
        mass = 0.3 * mt
        below = v[moment] * mt * l / mass
        legs.append((mass, below, v[c] * mt * l**2 - mass * below**2))
        rest -= mass
    return legs, rest


@pytest.mark.parametrize('with_springs', [False, True])
@pytest.mark.parametrize('payload', [None, ('inner', 1.3, 0.4), ('outer', 0.9, 0.3)])
@pytest.mark.parametrize('stance', ['inner', 'outer'])
def test_compass_gait_in_drake(drake, links, springs, stance, payload, with_springs):
    v = links.values
    l = v['leg_length']
    legs, hip = leg_bodies(v)
    standing, swinging = legs if stance == 'inner' else legs[::-1]
    names = ['inner', 'outer'] if stance == 'inner' else ['outer', 'inner']

    def merged(parts):
        mass = sum(m for m, _, _ in parts)
        centre = sum(m * z for m, z, _ in parts) / mass
        return mass, centre, sum(i + m * (z - centre) ** 2 for m, z, i in parts)

    first = [(standing[0], l - standing[1], standing[2]), (hip, l, 0.0)]
    second = [(swinging[0], -swinging[1], swinging[2])]
    model = links
    if payload is not None:
        leg, mass, distance = payload
        model = links.with_effect('payload', at=leg, mass=mass, distance=distance)
        if leg == names[0]:
            first.append((mass, distance, 0.0))
        else:
            second.append((mass, distance - l, 0.0))
    used = springs if with_springs else ()
    held = [
        (
            names.index(s.body), s.point - (0 if s.body == names[0] else l), s.anchor,
            s.stiffness, s.free_length,
        )
        for s in used
    ]  # fmt: skip
    chain = DrakeChain(drake, [(*merged(first), l), (*merged(second), 0)], v['gravity'], held)
    q, rates = (START[:2], START[2:]) if stance == 'inner' else (START[1::-1], START[:1:-1])
    # The hip joint's torque turns the swing leg on the stance leg.
    sign = -1.0 if stance == 'inner' else 1.0
    n = 200
    torques = np.column_stack([np.zeros(n), sign * TORQUE[:n]])
    found = chain.simulate([q[0], q[1] - q[0]], [rates[0], rates[1] - rates[0]], torques, 0.002)
    absolute = np.column_stack(
        [found[:, 0], found[:, 0] + found[:, 1], found[:, 2], found[:, 2] + found[:, 3]]
    )
    order = [0, 1, 2, 3] if stance == 'inner' else [1, 0, 3, 2]
    states, _ = simulate(
        model, Setup(stance=stance, springs=used), TIME[:n], TORQUE[:n, None], START
    )
    np.testing.assert_allclose(absolute[:, order], states, atol=2e-6)


def quantities(name, values):
    from cg_description.model_file import ModelFile, Quantity
    from cg_dynamics.mechanisms import mechanism
    from cg_dynamics.model import Model

    units = {p.name: p.unit for p in mechanism(name).parameters}
    return Model.from_file(
        ModelFile(name, name, {key: Quantity(value, units[key]) for key, value in values.items()})
    )


def test_pendulum_in_drake(drake):
    m, r, inertia, g = 1.3, 0.37, 0.021, 9.81
    model = quantities(
        'pendulum',
        {'inertia': inertia + m * r**2, 'gravity_torque': m * g * r, 'gravity': g},
    )
    chain = DrakeChain(drake, [(m, -r, inertia, 0.0)], g)
    found = chain.simulate([0.4], [1.1], TORQUE[:, None], 0.002)
    states, _ = simulate(model, Setup(), TIME, TORQUE[:, None], np.array([0.4, 1.1]))
    np.testing.assert_allclose(found, states, atol=1e-6)


def test_double_pendulum_in_drake(drake):
    m1, r1, i1, l1, m2, r2, i2, g = 1.1, 0.21, 0.013, 0.43, 0.7, 0.27, 0.019, 9.81
    model = quantities(
        'double_pendulum',
        {
            'upper_inertia': i1 + m1 * r1**2 + m2 * l1**2, 'lower_inertia': i2 + m2 * r2**2,
            'coupling': m2 * r2 * l1, 'upper_gravity': (m1 * r1 + m2 * l1) * g,
            'upper_length': l1, 'gravity': g,
        },
    )  # fmt: skip
    chain = DrakeChain(drake, [(m1, -r1, i1, -l1), (m2, -r2, i2, 0.0)], g)
    start = np.array([0.4, -0.7, 1.1, 0.5])
    n = 250
    torques = np.column_stack([0.3 * TORQUE[:n], 0.1 * TORQUE[n : 2 * n]])
    found = chain.simulate(start[:2], start[2:], torques, 0.002)
    states, _ = simulate(model, Setup(), TIME[:n], torques, start)
    np.testing.assert_allclose(found, states, atol=1e-6)
