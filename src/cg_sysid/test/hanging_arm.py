"""An arm of three joints under position control, simulated by our own model, as data sets."""

import numpy as np

from cg_description.model_file import ModelFile
from cg_dynamics.assemble import parameter_vector
from cg_dynamics.effects.effect import TIME
from cg_dynamics.model import Model
from cg_dynamics.rig import Setup
from cg_dynamics.rollout.compiled import compile_model
from cg_interfaces import channels
from cg_sysid.records.record import Record

SAMPLE = 0.004
LINKS = (  # name, axis, mass in kg, its centre and the joint's place in m
    ('hip', '1 0 0', 2.1, '0 0 -0.05', '0 0 0'),
    ('thigh', '0 1 0', 1.7, '0.01 0.02 -0.14', '0 0.05 -0.08'),
    ('shank', '0 1 0', 0.8, '0 0.01 -0.12', '0.01 0 -0.31'),
)
NOISE = 5e-5  # rad


def urdf() -> str:
    """Hip about x, then two links about y."""
    text, parent = '<robot name="leg"><link name="base"/>', 'base'
    for k, (name, axis, mass, centre, place) in enumerate(LINKS):
        i = mass * 0.006 * (1 + 0.3 * k)
        text += (
            f'<link name="{name}"><inertial><mass value="{mass}"/><origin xyz="{centre}"/>'
            f'<inertia ixx="{i}" iyy="{1.1 * i}" izz="{0.4 * i}" ixy="0" ixz="0" iyz="0"/>'
            f'</inertial></link><joint name="{name}_joint" type="revolute">'
            f'<parent link="{parent}"/><child link="{name}"/><origin xyz="{place}"/>'
            f'<axis xyz="{axis}"/></joint>'
        )
        parent = name
    return text + '</robot>'


def nominal() -> Model:
    """With plain friction at each joint."""
    model = Model.from_file(
        ModelFile(name='leg', mechanism='urdf', parameters={}, robot={'urdf': urdf()})
    )
    for joint, size in zip(model.mechanism.driven, (0.2, 0.15, 0.1), strict=True):
        model = model.with_effect('viscous_friction', joint, coefficient=size)
        model = model.with_effect('coulomb_friction', joint, torque=size)
    return model


def recorded(model: Model, seconds: float, seed: int, setup: Setup = Setup()) -> Record:  # noqa: B008
    """The model follows smooth ways by a controller that knows nothing of it."""
    random = np.random.default_rng(seed)
    compiled, p = compile_model(model, setup), parameter_vector(model, setup)
    n = len(model.mechanism.coordinates)
    w, phase = 2 * np.pi * random.uniform(0.2, 1.3, (n, 4)), random.uniform(0, 6, (n, 4))
    time = np.arange(round(seconds / SAMPLE) + 1) * SAMPLE
    grown = 1 - np.exp(-4 * time[:, None] ** 2)
    ways = grown * 0.3 * np.sin(w * time[:, None, None] + phase).sum(axis=2)
    rates = np.gradient(ways, SAMPLE, axis=0)
    kinematics = model.mechanism.kinematics(setup)  # joints that are locked do not move
    basis, m = np.asarray(kinematics.basis), len(kinematics.names)
    offset = np.broadcast_to(np.asarray(kinematics.offset).ravel(), n)
    x = compiled.initial_state(np.zeros(2 * m), np.zeros(compiled.nu), p)
    states, torques = np.zeros((len(time), compiled.nx)), np.zeros((len(time), compiled.nu))
    if TIME in compiled.input_names:
        torques[:, compiled.input_names.index(TIME)] = time
    for k in range(len(time)):
        states[k] = x
        position, rate = basis @ x[:m] + offset, basis @ x[m : 2 * m]
        torques[k, :n] = 60 * (ways[k] - position) + 3 * (rates[k] - rate)
        compiled.advance(x, torques[k], p, SAMPLE / 4, 4)
    seen = compiled.outputs(time, torques, states, p)
    seen = seen + NOISE * random.standard_normal(seen.shape)
    body = model.mechanism
    return Record(
        name=f'ways_{seed}',
        stamp_ns=1_700_000_000_000_000_000 + np.round(time * 1e9).astype(np.int64)
        + 60_000_000_000 * seed,
        inputs=dict(zip(body.inputs, torques.T[:n], strict=True)),
        outputs=dict(zip(body.outputs, seen.T, strict=True)),
        mechanism=channels.interface(body),
        setup=setup,
    )  # fmt: skip
