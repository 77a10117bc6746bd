"""What a small unknown torque would do to the outputs: linear response about the measured motion.

Each record is cut into short pieces. The model is simulated along each from a motion fitted to
that piece alone, so that it stays close to what was measured however wrong it is, and what it
misses there is, to first order,

    r = H w + J dtheta + J0 dx0 + e                                                   (RESP)

with w the torque that is missing on each coordinate, held over short slots, dtheta the
parameters, dx0 the initial motion, and e errors of the sensors. dx0 is eliminated.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise

import casadi as ca
import numpy as np

from cg_dynamics.assemble import parameter_vector
from cg_dynamics.effects.effect import CLOCKS, TIME
from cg_dynamics.model import Model
from cg_dynamics.rig import Setup
from cg_dynamics.rollout.compiled import CompiledModel, compile_model
from cg_sysid.identification.data_set import DataSet, initial_motion
from cg_sysid.identification.identify import fit, in_data_set, score
from cg_sysid.identification.unknowns import Unknown, awake

PIECES_S = (0.5, 0.2, 0.1, 0.05)
FEWEST_IN_PIECE = 5  # samples of every output in a piece
CLOSE = 30.0  # chi2 per sample on a piece up to which it is short enough to be linear
PROBED = 5  # one of so many pieces tells whether they are short enough
MOST_PIECES = 480  # of all records together; what is beyond adds little
LOOSE_RAD, LOOSE_RAD_S = 0.3, 3.0  # least standard deviation of a piece's initial motion
SAMPLES_HZ = 128.0  # of each output and of the torque


@dataclass(frozen=True)
class Piece:
    """One piece of a record, linearised. m samples of all outputs stacked, over noise.

    Attributes:
        record: Index of the record among all.
        held: Whether it is one that judges.
        missed: r, measured less simulated, shape (m,).
        torque: H, shape (m, n, slots) for n coordinates.
        parameters: J, shape (m, k).
        samples: Which output each of the m samples is of, shape (m,).
        project: Orthonormal columns to which everything here is orthogonal, shape (m, 2m0).
        sigma: Noise of each sample, in its unit, shape (m,).
        at_slots: Signals where the torque acts: see `signals_of`, each of shape (slots,).
        at_samples: The same where outputs were sampled, each of shape (m,).
    """

    record: int
    held: bool
    missed: np.ndarray
    torque: np.ndarray
    parameters: np.ndarray
    samples: np.ndarray
    project: np.ndarray
    sigma: np.ndarray
    at_slots: Mapping[str, np.ndarray]
    at_samples: Mapping[str, np.ndarray]

    @property
    def degrees(self) -> int:
        """Samples less those that the initial motion took."""
        return len(self.missed) - self.project.shape[1]

    def to_torque(self, row: np.ndarray) -> 'Response':
        """How the piece responds to torques on one joint, one in each slot.

        Args:
            row: Generalised force per torque, shape (n,).
        """
        response = np.tensordot(self.torque, row, (1, 0))
        return Response(
            self.parameters.T @ response, self.missed @ response,
            np.asarray(np.linalg.qr(response, mode='r')), np.zeros((0, response.shape[1])),
        )  # fmt: skip

    def to_error(self, channel: int) -> 'Response':
        """How the piece responds to errors of one sensor, one at each of its samples."""
        own = self.samples == channel
        weight = 1 / self.sigma[own]
        return Response(
            self.parameters[own].T * weight, self.missed[own] * weight, weight,
            self.project[own].T * weight,
        )  # fmt: skip


@dataclass(frozen=True)
class Response:
    """How a piece responds to a forcing f at n instants: A f, shape (m,), never formed itself.

    Fits ask for inner products only. They come from matrices of n rows at most in place of m:
    f^T A^T A g = (S f)^T (S g) - (L f)^T (L g).

    Attributes:
        parameters: J^T A, shape (k, n).
        missed: r^T A, shape (n,).
        square: S, shape (rows, n); where it is diagonal, its diagonal, shape (n,).
        start: L, what the initial motion explains of the response, shape (2m0, n).
    """

    parameters: np.ndarray
    missed: np.ndarray
    square: np.ndarray
    start: np.ndarray

    def times(self, carrier: np.ndarray) -> 'Response':
        """The response to f times a signal, shape (n,)."""
        return Response(
            self.parameters * carrier, self.missed * carrier, self.square * carrier,
            self.start * carrier,
        )  # fmt: skip

    def squared(self, basis: np.ndarray) -> np.ndarray:
        """S g of each column g of a basis, shape (..., n, k) -> (..., rows, k)."""
        return self.square @ basis if self.square.ndim == 2 else self.square[:, None] * basis

    def with_constant(self) -> np.ndarray:
        """A^T A 1: of a constant forcing with one at each instant, shape (n,)."""
        one = np.ones((len(self.missed), 1))
        own, taken = self.squared(one)[:, 0], (self.start @ one)[:, 0]
        mine = self.square.T @ own if self.square.ndim == 2 else self.square * own
        return mine - self.start.T @ taken

    def among(self, basis: np.ndarray) -> np.ndarray:
        """Inner products of the responses to the columns of a basis, (n, k) -> (k, k)."""
        own, taken = self.squared(basis), self.start @ basis
        return own.T @ own - taken.T @ taken


@dataclass(frozen=True)
class Pieces:
    """All records in pieces, and what they were linearised about.

    Attributes:
        all: The pieces.
        model: The model, its parameters identified on some of the pieces.
        unknowns: Those parameters, in the order of the columns of `Piece.parameters`.
        length: Of a piece in s.
    """

    all: tuple[Piece, ...]
    model: Model
    unknowns: tuple[Unknown, ...]
    length: float


def pieces_of(
    model: Model,
    train: Sequence[DataSet],
    held: Sequence[DataSet],
    bounds: Mapping[str, float] | None = None,
) -> Pieces:
    """Cut all records into the longest pieces on which the model stays close to them.

    Args:
        model: What is believed.
        train: Records to learn from.
        held: Records that judge.
        bounds: Parameters that stay near the model's value (`unknowns_of`).

    Raises:
        IdentificationError: if the records are too short to be cut.
    """
    data_sets = (*train, *held)
    for length in PIECES_S:
        cuts = [
            (k, p) for k, data_set in enumerate(data_sets) for p in cut(model, data_set, length)
        ]
        # What a wrong model was fitted to as a whole may be far from the truth.
        probe = fit(model, [piece for _, piece in cuts[::PROBED]], bounds=bounds)
        if probe.normalised_error < CLOSE:
            break
    if len(cuts) > MOST_PIECES:
        cuts = [cuts[i] for i in np.linspace(0, len(cuts) - 1, MOST_PIECES).astype(int)]
    names = [u.name for u in probe.unknowns]
    fitted = score(probe.model, [piece for _, piece in cuts])
    linear: dict[int, _Linear] = {}
    found = []
    for (k, piece), motion in zip(cuts, fitted.motions, strict=True):
        compiled = compile_model(awake(probe.model), piece.setup)
        if id(compiled) not in linear:
            linear[id(compiled)] = _Linear(probe.model, compiled, names, piece.setup)
        made = linear[id(compiled)].piece(piece, motion, k, k >= len(train))
        if made is not None:
            found.append(made)
    return Pieces(tuple(found), probe.model, probe.unknowns, length)


def cut(model: Model, data_set: DataSet, length: float) -> list[DataSet]:
    """Pieces of a data set, of about so many seconds; the time of the record goes on in them."""
    count = max(1, round(data_set.duration / length))
    edges = np.searchsorted(data_set.time, np.linspace(0, data_set.duration, count + 1))
    edges[-1] = len(data_set.time)
    names = (*data_set.input_names, *CLOCKS)
    inputs = data_set.inputs_for(names)
    found = []
    recorded = np.isfinite(data_set.outputs).any(axis=0)
    for a, b in pairwise(edges):
        # A piece begins where it is first seen.
        a += int(np.argmax(np.isfinite(data_set.outputs[a:b]).any(axis=1)))
        time, outputs = data_set.time[a:b] - data_set.time[a], data_set.outputs[a:b]
        if (np.isfinite(outputs).sum(axis=0)[recorded] < FEWEST_IN_PIECE).any():
            continue
        motion, spread = initial_motion(
            model.mechanism, data_set.setup, time, outputs, data_set.sigma
        )
        # Where a sensor is wrong, so is what it says about the start of every piece.
        loose = np.repeat((LOOSE_RAD, LOOSE_RAD_S), len(motion) // 2)
        found.append(
            replace(
                data_set, time=time, inputs=inputs[a:b], input_names=names,
                outputs=outputs, motion=motion,
                motion_sigma=np.maximum(spread, loose),
            )
        )  # fmt: skip
    return found


class _Linear:
    """The symbolic derivatives of one compiled structure."""

    def __init__(self, model: Model, compiled: CompiledModel, names: Sequence[str], setup: Setup):
        self.model, self.compiled, self.names = model, compiled, list(names)
        e = compiled.equations
        basis = model.mechanism.kinematics(setup).basis
        by_force = ca.solve(e.mass_matrix, basis.T)
        self.functions = ca.Function(
            'linear',
            [e.x, e.u, e.p],
            [ca.densify(a) for a in
             (ca.jacobian(e.rates, e.x), ca.jacobian(e.outputs, e.x), by_force)],
        )  # fmt: skip
        self.m = e.coordinates

    def piece(self, piece: DataSet, motion: np.ndarray, record: int, held: bool) -> Piece | None:
        """One piece from what it has of its own; None where sensitivities run away."""
        compiled, m, names = self.compiled, self.m, self.names
        model, motion = in_data_set(self.model, motion)
        p = parameter_vector(model, piece.setup)
        u = piece.inputs_for(compiled.input_names)
        n, nx = len(piece.time), compiled.nx
        x0, by_motion, by_free = compiled.initial_sensitivity(motion, u[0], p)
        known = [name for name in names if name in compiled.free]
        s0 = np.zeros((nx, 2 * m + len(names)))
        s0[:, : 2 * m] = by_motion[:, : 2 * m]
        column = np.full(len(compiled.free), -1)
        for name in known:
            column[compiled.free.index(name)] = 2 * m + names.index(name)
            s0[:, 2 * m + names.index(name)] = by_free[:, compiled.free.index(name)]
        normal, y, jacobian = compiled.normal(
            piece.time, u, x0, s0, p, column, piece.outputs, 1 / piece.sigma, keep=True
        )
        if normal.rows < n or y is None or jacobian is None or not np.isfinite(jacobian).all():
            return None
        states = compiled.simulate(piece.time, u, x0, p)
        a, c, b = (
            np.asarray(part).reshape(part.shape[0], n, -1).transpose(1, 0, 2)
            for part in self.functions(states.T, u.T, p)
        )
        slots = min(max(1, round(SAMPLES_HZ * piece.duration)), n - 1)
        torque = self._response(piece.time, a, b, slots)
        torque = np.einsum('kyx,kxj->kyj', c, torque)
        rows, samples = self._samples(piece)
        sigma = piece.sigma[samples]

        def stacked(values: np.ndarray) -> np.ndarray:
            return values[rows, samples] / sigma.reshape(-1, *[1] * (values.ndim - 2))

        orthonormal, _ = np.linalg.qr(stacked(jacobian[:, :, : 2 * m]))

        def without_start(values: np.ndarray) -> np.ndarray:
            return values - orthonormal @ (orthonormal.T @ values)

        middle = np.minimum(((np.arange(slots) + 0.5) * (n - 1) / slots).astype(int), n - 1)
        signals = signals_of(self.model, piece, states)
        return Piece(
            record=record,
            held=held,
            missed=without_start(stacked(piece.outputs - y)),
            torque=without_start(stacked(torque)).reshape(len(rows), -1, slots),
            parameters=without_start(stacked(jacobian[:, :, 2 * m :])),
            samples=samples,
            project=orthonormal,
            sigma=sigma,
            at_slots={name: values[middle] for name, values in signals.items()},
            at_samples={name: values[rows] for name, values in signals.items()},
        )

    def _response(self, time: np.ndarray, a: np.ndarray, b: np.ndarray, slots: int) -> np.ndarray:
        """Deviation of the state by a unit torque in each slot, shape (n, nx, n_q slots)."""
        n, nx, nq = len(time), self.compiled.nx, b.shape[2]
        found = np.zeros((n, nx, nq, slots))
        force = np.zeros((n, nx, nq))
        force[:, self.m : 2 * self.m] = b
        h = np.diff(time)[:, None, None]
        eye = np.eye(nx)
        # The implicit midpoint rule: friction near standstill is stiff.
        inverse = np.linalg.inv(eye - 0.5 * h * a[:-1])
        forward, kick = inverse @ (eye + 0.5 * h * a[:-1]), inverse @ (h * force[:-1])
        slot = (np.arange(n - 1) * slots) // (n - 1)
        for k in range(n - 1):
            found[k + 1] = np.tensordot(forward[k], found[k], (1, 0))
            found[k + 1, :, :, slot[k]] += kick[k]
        return found.reshape(n, nx, -1)

    def _samples(self, piece: DataSet) -> tuple[np.ndarray, np.ndarray]:
        """Rows and outputs of the samples that count."""
        rows, outputs = [], []
        for j, channel in enumerate(piece.outputs.T):
            present = np.flatnonzero(np.isfinite(channel))
            enough = max(1, round(SAMPLES_HZ * piece.duration))
            taken = present[:: max(1, len(present) // enough)]
            rows.append(taken)
            outputs.append(np.full(len(taken), j))
        return np.concatenate(rows), np.concatenate(outputs)


def simulated_signals(
    model: Model, data_set: DataSet, motion: np.ndarray
) -> dict[str, np.ndarray]:
    """`signals_of` along a data set that a model simulates from an initial motion, (2m,)."""
    compiled, p = compile_model(model, data_set.setup), parameter_vector(model, data_set.setup)
    u = data_set.inputs_for(compiled.input_names)
    states = compiled.simulate(data_set.time, u, compiled.initial_state(motion, u[0], p), p)
    return signals_of(model, data_set, states)


def signals_of(model: Model, data_set: DataSet, states: np.ndarray) -> dict[str, np.ndarray]:
    """What a torque or an error may follow, by the names of `LearnedEffect.follows`.

    Args:
        model: The model.
        data_set: The record.
        states: What was simulated along it, shape (n, nx).

    Returns:
        Name -> values, each of shape (n,): `angle`, `rate` and `torque` of joints, of coordinates,
        of the legs of a compass gait and of what ideal sensors report, and the time.
    """
    body = model.mechanism
    basis = np.asarray(ca.DM(body.kinematics(data_set.setup).basis), float)
    m = basis.shape[1]
    q, v = states[:, :m] @ basis.T, states[:, m : 2 * m] @ basis.T
    rows = {name: np.eye(len(body.coordinates))[i] for i, name in enumerate(body.coordinates)}
    rows |= {joint: np.array(row) for joint, row in body.joints.items()}
    if body.name == 'compass_gait':
        rows |= {leg: np.eye(2)[i] for i, leg in enumerate(body.bodies)}
        rows['stance'] = rows[data_set.setup.stance]
    found = {TIME: data_set.inputs_for((TIME,))[:, 0]}
    for name, row in rows.items():
        found |= {f'angle:{name}': q @ row, f'rate:{name}': v @ row}
    for joint, name in zip(body.joints, body.inputs, strict=True):
        torque = data_set.inputs_for((name,))[:, 0]
        found |= {f'torque:{joint}': torque, f'torque:{name}': torque}
    symbols = [ca.SX.sym('q', q.shape[1]), ca.SX.sym('v', v.shape[1])]
    ideal = body.sensors(*symbols)
    readings = ca.Function('sensors', symbols, [ca.vertcat(*ideal.values())])
    values = np.asarray(readings(q.T, v.T))
    moving = np.asarray(readings(v.T, np.zeros_like(v).T))  # all sensors are linear
    for i, (channel, kind) in enumerate(body.sensor_kinds.items()):
        if kind == 'gyro':
            found[f'rate:{channel}'] = values[i]
        else:
            found |= {f'angle:{channel}': values[i], f'rate:{channel}': moving[i]}
    return found
