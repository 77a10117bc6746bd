"""What does a rollout of a robot of a URDF cost, by its number of joints, beside MuJoCo?

    ./cg exec python bench/robots_rollout.py [--write]      bench/results/robots_rollout.md

Random trees of turning joints (random_trees.py of the tests), each joint with viscous and dry
friction, swinging under gravity: 10 s at 500 Hz, Runge-Kutta of order 4 at steps of 2 ms in both
engines, MuJoCo in its own loop in C. Sensitivities are those that a fit asks for: of all that is
identified, and of the start; and once more where all sensors are late by 4.7 ms, which is
identified as well. MuJoCo has none of a whole rollout; as many rollouts more as there
are columns is what central differences would take half of.

CPU time of the calling thread, the median of the repetitions, which alternate between engines.
Compile time is wall time of the first call, with an empty cache.
"""

import argparse
import os
import sys
import tempfile
import time
from pathlib import Path

import mujoco
import numpy as np
from mujoco import rollout

sys.path.insert(0, str(Path(__file__).parents[1] / 'src/cg_dynamics/test'))
from random_trees import random_tree

from cg_description.model_file import ModelFile
from cg_dynamics.assemble import parameter_vector
from cg_dynamics.model import Model
from cg_dynamics.rig import Setup
from cg_dynamics.rollout.compiled import compile_model
from cg_interfaces import channels
from cg_sysid.identification.data_set import prepare
from cg_sysid.identification.simulation_error import Problem, follow
from cg_sysid.identification.unknowns import unknowns_of
from cg_sysid.records.record import Record

JOINTS = 1, 2, 3, 6, 7
SEED = 11
STEP, ROWS = 0.002, 5001
TIMES = 21
VISCOUS, DRY = 1.5, 0.3  # N m s/rad, N m
LATE = 0.0047  # s, between two rows
SETUP = Setup()
RESULT = Path(__file__).parent / 'results/robots_rollout.md'


def robot(joints: int) -> tuple[Model, str]:
    """Our model of a tree, and its URDF."""
    text = random_tree(SEED, joints, slide=0.0)
    model = Model.from_file(
        ModelFile(name='tree', mechanism='urdf', parameters={}, robot={'urdf': text})
    )
    for joint in model.mechanism.driven:
        model = model.with_effect('viscous_friction', joint, coefficient=VISCOUS)
        model = model.with_effect('coulomb_friction', joint, torque=DRY)
    return model, text


def engine(text: str) -> mujoco.MjModel:
    """MuJoCo's model of the same robot."""
    extension = '<mujoco><compiler fusestatic="false" discardvisual="true"/></mujoco>'
    model = mujoco.MjModel.from_xml_string(text.replace('</robot>', f'{extension}</robot>'))
    model.dof_damping[:], model.dof_frictionloss[:] = VISCOUS, DRY
    model.opt.timestep, model.opt.integrator = STEP, mujoco.mjtIntegrator.mjINT_RK4
    model.opt.disableflags |= int(mujoco.mjtDisableBit.mjDSBL_CONTACT)
    model.opt.disableflags |= int(mujoco.mjtDisableBit.mjDSBL_LIMIT)
    return model


def record_of(model: Model, states: np.ndarray, stamps: np.ndarray) -> Record:
    """What encoders of 1e-5 rad would say of it."""
    noise = np.random.default_rng(SEED).normal(0, 1e-5, states.shape)
    body = model.mechanism
    return Record(
        name='swing', stamp_ns=stamps,
        inputs={name: np.zeros(ROWS) for name in body.inputs},
        outputs={f'{j}_position': states[:, k] + noise[:, k]
                 for k, j in enumerate(body.coordinates)},
        mechanism=channels.interface(body),
    )  # fmt: skip


def cpu(call) -> float:
    """CPU time of a call, s."""
    began = time.thread_time()
    call()
    return time.thread_time() - began


def row(joints: int) -> str:
    """A line of the table."""
    model, text = robot(joints)
    began = time.perf_counter()
    compiled = compile_model(model, SETUP)
    p, moment = parameter_vector(model, SETUP), np.arange(ROWS) * STEP
    u = np.zeros((ROWS, compiled.nu))
    x0 = compiled.initial_state(np.zeros(2 * joints), u[0], p)
    states = compiled.simulate(moment, u, x0, p)
    plain_compile = time.perf_counter() - began
    data_sets = prepare(model, [record_of(model, states, np.round(moment * 1e9).astype(np.int64))])
    unknowns = unknowns_of(model)
    motion = data_sets[0].motion
    problem = Problem(model, data_sets, unknowns, [motion], 1.0)
    values = np.array([unknown.prior for unknown in unknowns])
    late = model.with_effect('sensor_delay', delay=LATE)
    late_unknowns = unknowns_of(late)
    late_problem = Problem(late, data_sets, late_unknowns, [motion], 1.0)
    late_values = np.array([unknown.prior for unknown in late_unknowns])
    began = time.perf_counter()
    follow(problem, 0, values, motion, np.inf).normal()
    compile_s = time.perf_counter() - began
    theirs, data = engine(text), None
    data = mujoco.MjData(theirs)
    start = np.zeros((1, mujoco.mj_stateSize(theirs, mujoco.mjtState.mjSTATE_FULLPHYSICS)))
    calls = {
        'ours': lambda: compiled.simulate(moment, u, x0, p),
        'fit': lambda: follow(problem, 0, values, motion, np.inf).normal(),
        'late': lambda: follow(late_problem, 0, late_values, motion, np.inf).normal(),
        'mujoco': lambda: rollout.rollout(theirs, data, start, nstep=ROWS - 1),
    }
    spent = {name: [] for name in calls}
    for _ in range(TIMES):
        for name, call in calls.items():
            spent[name].append(cpu(call))
    ours, sensitive, sensitive_late, mj = (1e3 * float(np.median(spent[name])) for name in calls)
    columns = len(motion) + len(unknowns)
    return (
        f'| {joints} | {ours:.2f} | {mj:.1f} | {mj / ours:.0f} | {columns} | {sensitive:.1f} '
        f'| {sensitive_late:.1f} | {columns * mj / sensitive:.0f} '
        f'| {plain_compile:.1f} | {compile_s:.1f} |'
    )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument('--write', action='store_true')
    options = parser.parse_args()
    lines = [
        '# Cost of a rollout of a robot of a URDF', '',
        'Command: `./cg exec python bench/robots_rollout.py --write`. 10 s at 500 Hz, CPU ms of '
        f'one core, median of {TIMES}; compile times are wall time, once for each structure.', '',
        '| joints | ours | MuJoCo | MuJoCo / ours | columns | ours with sensitivities '
        '| sensors late | MuJoCo, a rollout for each column / ours | compile, s '
        '| of sensitivities, s |',
        '|---:|---:|---:|---:|---:|---:|---:|---:|---:|---:|',
    ]  # fmt: skip
    with tempfile.TemporaryDirectory() as cache:
        os.environ['CG_CACHE'] = cache
        for joints in JOINTS:
            lines.append(row(joints))
            print(lines[-1], flush=True)
    if options.write:
        RESULT.write_text('\n'.join(lines) + '\n')


if __name__ == '__main__':
    main()
