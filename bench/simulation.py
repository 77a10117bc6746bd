"""How fast is a rollout? One stance phase of the robot in seven engines, same step, one table.

    python bench/simulation.py            prints the table
    python bench/simulation.py --write    stores it as bench/results/simulation.md

The problem: inner stance, no springs, no friction, hip body without mass (the other engines have
no joint that bisects), a torque that changes every 2 ms, 1 s in Runge-Kutta steps of 2 ms. Every
route must end where a fine integration ends; the table says how close it came. CPU time of the
calling thread, best of the repetitions, so that a busy machine disturbs little. Only the ratios
of one run are a result.
"""

import argparse
import importlib
import importlib.metadata
import platform
import resource
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from scipy.integrate import solve_ivp

from cg_description.paths import model_path
from cg_dynamics.assemble import parameter_vector
from cg_dynamics.model import Model
from cg_dynamics.rig import Setup
from cg_dynamics.rollout.batch import batch_source, simulate_batch
from cg_dynamics.rollout.compiled import CompiledModel, assemble, compile_model
from cg_dynamics.rollout.compiler import build, compiler
from cg_dynamics.rollout.native import states_source, windows_source
from cg_dynamics.rollout.vector_code import FLAGS

STEP = 0.002
ROWS = 501
BATCH = 2048
START = np.array([0.05, 0.1, 0.2, -0.3])
TIME = np.arange(ROWS) * STEP
TORQUE = np.repeat(np.random.default_rng(0).normal(0, 3, 101), 5)[:ROWS]


def two_links() -> Model:
    model = Model.load(model_path('compass_gait_mit'))
    model = model.without_effect('viscous_friction').without_effect('coulomb_friction')
    return model.with_values({'c3': 1e-7, 'c6': 0.0})


MODEL, SETUP = two_links(), Setup()
VALUES = MODEL.values
P = parameter_vector(MODEL, SETUP)

# A route: steps of one call, and the call, which returns the final (q_in, q_out, rates).
Route = tuple[int, Callable[[], np.ndarray]]


def compiled_route() -> Route:
    c = compile_model(MODEL, SETUP)
    u = TORQUE[:, None]
    return ROWS - 1, lambda: c.simulate(TIME, u, START, P)[-1]


def batch_route() -> Route:
    x0 = np.tile(START, (BATCH, 1))
    u = TORQUE[:, None]
    return BATCH * (ROWS - 1), lambda: simulate_batch(MODEL, SETUP, TIME, u, x0, P)[-1]


def machine_route() -> Route:
    c = compile_model(MODEL, SETUP)
    interpreted = CompiledModel(c.equations, c.free, native=False)
    u = TORQUE[:, None]
    return ROWS - 1, lambda: interpreted.simulate(TIME, u, START, P)[-1]


def numpy_rates(x: np.ndarray, u: float) -> np.ndarray:
    """The manipulator equations as one writes them down: Eq. 4.4 to 4.6 for two links."""
    l, mt, g = VALUES['leg_length'], VALUES['total_mass'], VALUES['gravity']
    c1, c2, c4, c5 = (VALUES[name] for name in ('c1', 'c2', 'c4', 'c5'))
    c3 = VALUES['c3']
    angle = x[0] - x[1]
    coupling = c3 - c5 * np.cos(angle)
    H = np.array([[1 + c1 - 2 * c4, coupling], [coupling, c2]])
    C = np.array([[0.0, -c5 * np.sin(angle) * x[3]], [c5 * np.sin(angle) * x[2], 0.0]])
    G = g / l * np.array([(c4 - 1) * np.sin(x[0]), c5 * np.sin(x[1])])
    B = np.array([1.0, -1.0]) / (mt * l**2)
    return np.concatenate([x[2:], np.linalg.solve(H, B * u - C @ x[2:] - G)])


def numpy_route() -> Route:
    def run():
        x = START.copy()
        for u in TORQUE[:-1]:
            k1 = numpy_rates(x, u)
            k2 = numpy_rates(x + STEP / 2 * k1, u)
            k3 = numpy_rates(x + STEP / 2 * k2, u)
            k4 = numpy_rates(x + STEP * k3, u)
            x = x + STEP / 6 * (k1 + 2 * k2 + 2 * k3 + k4)
        return x

    return ROWS - 1, run


def solve_ivp_route() -> Route:
    def run():
        # The torque is looked up in each evaluation; steps no longer than the torque's.
        return solve_ivp(
            lambda t, x: numpy_rates(x, TORQUE[min(int(t / STEP + 1e-9), ROWS - 1)]),
            (0, TIME[-1]), START, method='RK45', max_step=STEP, first_step=STEP,
        ).y[:, -1]  # fmt: skip

    return ROWS - 1, run


def links() -> tuple[list[tuple[float, float, float]], float]:
    """(mass, place below the hip, inertia) of the legs and the mass at the hip, with our lumps."""
    l, mt = VALUES['leg_length'], VALUES['total_mass']
    legs = []
    for inertia, moment in (('c1', 'c4'), ('c2', 'c5')):
        mass = 0.3 * mt
        below = VALUES[moment] * mt * l / mass
        legs.append((mass, below, VALUES[inertia] * mt * l**2 - mass * below**2))
    return legs, 0.4 * mt


def stance_link() -> tuple[float, float, float]:
    """(mass, height above the foot, inertia) of the stance leg with the hip mass on it."""
    (leg, _), hip = links()
    l = VALUES['leg_length']
    mass = leg[0] + hip
    centre = (leg[0] * (l - leg[1]) + hip * l) / mass
    inertia = leg[2] + leg[0] * (l - leg[1] - centre) ** 2 + hip * (l - centre) ** 2
    return mass, centre, inertia


def mujoco_route(integrator: str) -> Route:
    import mujoco
    from mujoco import rollout

    mass, centre, inertia = stance_link()
    swing = links()[0][1]
    model = mujoco.MjModel.from_xml_string(f"""
<mujoco>
  <option gravity="0 0 {-VALUES['gravity']}" integrator="{integrator}" timestep="{STEP}">
    <flag contact="disable" constraint="disable"/>
  </option>
  <worldbody><body>
    <joint name="stance" axis="0 1 0"/>
    <inertial pos="0 0 {centre!r}" mass="{mass!r}" diaginertia="{(str(inertia) + ' ') * 3}"/>
    <body pos="0 0 {VALUES['leg_length']}">
      <joint name="hip" axis="0 1 0"/>
      <inertial pos="0 0 {-swing[1]!r}" mass="{swing[0]!r}"
       diaginertia="{(str(swing[2]) + ' ') * 3}"/>
    </body>
  </body></worldbody>
  <actuator><motor joint="hip" gear="-1"/></actuator>
</mujoco>""")
    data = mujoco.MjData(model)
    data.qpos[:] = START[0], START[1] - START[0]
    data.qvel[:] = START[2], START[3] - START[2]
    initial = np.empty(mujoco.mj_stateSize(model, mujoco.mjtState.mjSTATE_FULLPHYSICS))
    mujoco.mj_getState(model, data, initial, mujoco.mjtState.mjSTATE_FULLPHYSICS)
    control = TORQUE[None, :-1, None]

    def run():
        # The engine's own loop in C; one from Python is several times slower.
        states, _ = rollout.rollout(model, data, initial[None], control)
        stance, hip, stance_rate, hip_rate = states[0, -1, 1:5]
        return np.array([stance, stance + hip, stance_rate, stance_rate + hip_rate])

    return ROWS - 1, run


def drake_route() -> Route:
    drake: Any = importlib.import_module('pydrake.all')

    builder = drake.DiagramBuilder()
    plant = drake.MultibodyPlant(0.0)
    plant.mutable_gravity_field().set_gravity_vector([0, 0, -VALUES['gravity']])
    swing = links()[0][1]
    parts = [('stance', *stance_link(), 0.0), ('hip', swing[0], -swing[1], swing[2],
             VALUES['leg_length'])]  # fmt: skip
    parent = plant.world_body()
    for name, mass, centre, inertia, place in parts:
        body = plant.AddRigidBody(
            name,
            drake.SpatialInertia.MakeFromCentralInertia(
                mass, [0, 0, centre], drake.RotationalInertia(inertia, inertia, inertia)
            ),
        )
        frame = plant.AddFrame(
            drake.FixedOffsetFrame(
                f'{name}_joint', parent.body_frame(), drake.RigidTransform([0, 0, place])
            )
        )
        joint = plant.AddJoint(drake.RevoluteJoint(name, frame, body.body_frame(), [0, 1, 0]))
        parent = body
    plant.AddJointActuator('motor', joint)
    plant.Finalize()
    builder.AddSystem(plant)
    # A held torque as a system, so that the loop over time stays in C++.
    source = builder.AddSystem(
        drake.TrajectorySource(drake.PiecewisePolynomial.ZeroOrderHold(TIME, -TORQUE[None]))
    )
    builder.Connect(source.get_output_port(), plant.get_actuation_input_port())
    diagram = builder.Build()
    simulator = drake.Simulator(diagram)
    drake.ResetIntegratorFromFlags(simulator, 'runge_kutta3', STEP)
    simulator.get_mutable_integrator().set_fixed_step_mode(True)

    def run():
        context = simulator.get_mutable_context()
        context.SetTime(0.0)
        plant.SetPositionsAndVelocities(
            plant.GetMyMutableContextFromRoot(context),
            [START[0], START[1] - START[0], START[2], START[3] - START[2]],
        )
        simulator.Initialize()
        simulator.AdvanceTo(TIME[-1])
        stance, hip, stance_rate, hip_rate = plant.GetPositionsAndVelocities(
            plant.GetMyContextFromRoot(context)
        )
        return np.array([stance, stance + hip, stance_rate, stance_rate + hip_rate])

    return ROWS - 1, run


ROUTES = {
    'batch, eight to a register': batch_route,
    'compiled, one at a time': compiled_route,
    'CasADi virtual machine': machine_route,
    'MuJoCo, RK4, loop in C': lambda: mujoco_route('RK4'),
    'MuJoCo, Euler, loop in C': lambda: mujoco_route('Euler'),
    'Drake MultibodyPlant, RK3, loop in C++': drake_route,
    'solve_ivp, RK45': solve_ivp_route,
    'numpy, RK4': numpy_route,
}


def measure(route: Route, repetitions: int) -> tuple[float, np.ndarray]:
    """Steps per second of CPU time, and the final state."""
    steps, run = route
    final = run()
    # Short calls are repeated until a measurement takes a noticeable time.
    start = time.process_time()
    run()
    calls = max(1, int(0.05 / max(time.process_time() - start, 1e-6)))
    best = np.inf
    for _ in range(repetitions):
        start = time.process_time()
        for _ in range(calls):
            run()
        best = min(best, (time.process_time() - start) / calls)
    return steps / best, final


def build_times() -> dict[str, float]:
    """CPU time in s to bring a new model into being: equations, C source, compiler."""
    model = Model.load(model_path('compass_gait_mit')).with_effect('joint_flexibility')
    c = compile_model(model, SETUP)
    found = {}
    start = cpu_time()
    equations = assemble(model, SETUP)
    states, windows = states_source(equations), windows_source(equations, c.free)
    found['equations and C source'] = cpu_time() - start
    if compiler() is not None:
        with tempfile.TemporaryDirectory() as directory:
            start = cpu_time()
            build(states, Path(directory) / 'a.so', FLAGS)
            found['C compiler, rollouts'] = cpu_time() - start
            start = cpu_time()
            build(windows, Path(directory) / 'w.so', FLAGS)
            found['C compiler, sensitivities'] = cpu_time() - start
            start = cpu_time()
            build(batch_source(c), Path(directory) / 'b.so', FLAGS)
            found['C compiler, batch'] = cpu_time() - start
    return found


def cpu_time() -> float:
    """Of this process and of those it started."""
    usage = [resource.getrusage(w) for w in (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN)]
    return sum(u.ru_utime + u.ru_stime for u in usage)


def machine() -> str:
    cpu = 'unknown CPU'
    if Path('/proc/cpuinfo').exists():
        for line in Path('/proc/cpuinfo').read_text().splitlines():
            if line.startswith('model name'):
                cpu = line.partition(':')[2].strip()
                break
    versions = []
    for package in ('casadi', 'numpy', 'scipy', 'mujoco', 'drake'):
        try:
            versions.append(f'{package} {importlib.metadata.version(package)}')
        except importlib.metadata.PackageNotFoundError:
            continue
    return f'{cpu}, Python {platform.python_version()}, {", ".join(versions)}'


def table(repetitions: int) -> str:
    fine = compile_model(MODEL, SETUP)
    exact = START.copy()
    for u in TORQUE[:-1]:
        fine.advance(exact, np.array([u]), P, STEP / 20, 20)
    rates, errors = {}, {}
    for name, make in ROUTES.items():
        try:
            rates[name], final = measure(make(), repetitions)
        except ImportError as error:
            print(f'left out: {name} ({error})', file=sys.stderr)
            continue
        errors[name] = np.abs(final - exact).max()
    slowest, ours = rates['numpy, RK4'], rates['compiled, one at a time']
    lines = [
        '| route | steps/s | x numpy | x compiled | error at the end |',
        '|---|---:|---:|---:|---:|',
    ]
    for name in sorted(rates, key=lambda name: -rates[name]):
        lines.append(
            f'| {name} | {rates[name]:,.0f} | {rates[name] / slowest:.3g} '
            f'| {rates[name] / ours:.3g} | {errors[name]:.1e} |'
        )
    lines += ['', '| once per new model structure, with a flexible joint | s |', '|---|---:|']
    lines += [f'| {name} | {seconds:.2f} |' for name, seconds in build_times().items()]
    return '\n'.join(lines)


def main():
    parser = argparse.ArgumentParser(description=__doc__.partition('\n')[0])
    parser.add_argument('--write', action='store_true', help='store the table')
    parser.add_argument('--repetitions', type=int, default=7)
    arguments = parser.parse_args()
    found = table(arguments.repetitions)
    print(found)
    if arguments.write:
        target = Path(__file__).parent / 'results' / 'simulation.md'
        target.parent.mkdir(exist_ok=True)
        target.write_text(
            '# Simulation\n\n'
            'Command: `python bench/simulation.py --write`. '
            f'Machine: {machine()}; one core.\n\n'
            'One stance phase of the robot, 1 s in steps of 2 ms; what is compared with what is '
            'said at the top of `bench/simulation.py`. Figures are steps per second of CPU time; '
            'only ratios within one run count. Drake has no RK4: its RK3 evaluates the '
            'right-hand side three times a step, the others four (solve_ivp six). The error is '
            'the largest difference of the final state from a twenty times finer integration; '
            'Drake and solve_ivp see the next torque in the last stage of a step, and MuJoCo has '
            'no c3 of 1e-7.'
            f'\n\n{found}\n'
        )


if __name__ == '__main__':
    main()
