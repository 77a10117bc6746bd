"""Thousands of robots follow a tree at once: hybrid, closed loop, each from a node of its own.

A rollout is what `walk` of cg_dynamics and a `Tracker` do together: impacts located in time, the
leg changed, the torque of (FOL), limited and held for a sample. Here they run eight side by side
in the lanes of one register (rollouts.c). A lane whose robot has arrived or fallen takes the next
one, so what ends early costs little. Without a C compiler `walk` and `Tracker` do it themselves.
"""

import ctypes
import enum
import logging
import math
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import casadi as ca
import numpy as np

from cg_control.following.nodes import Nodes, Way, triangles
from cg_control.following.tracking import LEAST_TURN, Tracker, TrackingSettings
from cg_control.friction import friction_parameters, friction_torque
from cg_dynamics.assemble import acting_effects, parameter_vector, stamped
from cg_dynamics.effects.effect import CLOCKS
from cg_dynamics.errors import SimulationError
from cg_dynamics.mechanisms.compass_gait import CompassGait
from cg_dynamics.model import Model
from cg_dynamics.rig import STANCES, Setup
from cg_dynamics.rollout.compiled import CompiledModel, compile_model
from cg_dynamics.rollout.compiler import compiler, shared_library
from cg_dynamics.rollout.vector_code import (
    FLAGS,
    WIDTH,
    UnsupportedError,
    vector_code,
    vector_math,
)
from cg_dynamics.walking.contact import contact_law
from cg_dynamics.walking.hybrid import Walker, WalkOptions
from cg_dynamics.walking.impact import impact_function

log = logging.getLogger(__name__)

SAMPLE_TIME = 0.002  # s
LENGTH = 'leg_length'
# Of struct job in rollouts.c, in its order.
FIELDS: dict[Any, tuple[str, ...]] = {
    ctypes.c_void_p: ('leg', 'next', 'landing', 'late', 'way', 'span', 'edge', 'cost',
                      'normal', 'known', 'goal', 'p', 'x', 'elapsed', 'node', 'stance', 'samples',
                      'clock', 'outcome', 'impacts', 'time', 'visited', 'visit_cost',
                      'visit_state'),
    ctypes.c_double: ('pull', 'fastest', 'limit', 'sample_time', 'step', 'fall_angle',
                      'swing_angle', 'minimum_step', 'ahead', 'slope'),
    ctypes.c_long: ('p_each', 'visits', 'length_at'),
}  # fmt: skip


class Outcome(enum.IntEnum):
    """How a rollout ended."""

    ARRIVED = 1  # in the goal region of its leg, or in the tube of an orbit
    FALLEN = 2  # a leg is too far from upright, or the state ran away
    LEFT = 3  # the foot landed where no impact is planned
    TIMED_OUT = 4


@dataclass(frozen=True)
class Visits:
    """The nodes that each rollout came by, in order, its start first; V is the room for them.

    A node counts as visited at the first sample at which the reference is at it or beyond. Where
    a rollout fails, rho of these nodes is too large if it exceeds `cost`; nodes that the
    reference skipped, as the foot landed early, are not among them.

    Attributes:
        node: Index, -1 where there are no more, shape (B, V).
        cost: (x - x0)' S (x - x0) with reference and S of that sample, NaN likewise, (B, V).
        state: x at that sample, NaN likewise, shape (B, V, nx).
    """

    node: np.ndarray
    cost: np.ndarray
    state: np.ndarray


@dataclass(frozen=True)
class Rollouts:
    """How B robots fared.

    Attributes:
        outcome: An `Outcome` each, shape (B,).
        state: At the end, shape (B, nx) with all states of the robot.
        stance: Leg that stands then, index into STANCES, shape (B,).
        time: Of the end in s, shape (B,).
        node: Where the reference was, shape (B,),
        elapsed: since so many seconds, shape (B,).
        impacts: Steps taken, shape (B,).
        visits: None if no room was asked for.
    """

    outcome: np.ndarray
    state: np.ndarray
    stance: np.ndarray
    time: np.ndarray
    node: np.ndarray
    elapsed: np.ndarray
    impacts: np.ndarray
    visits: Visits | None


def follow(
    nodes: Nodes,
    robot: Model,
    start: np.ndarray,
    x: np.ndarray,
    duration: float | np.ndarray,
    *,
    goal: np.ndarray | None = None,
    elapsed: np.ndarray | None = None,
    known: Model | None = None,
    p: np.ndarray | None = None,
    settings: TrackingSettings | None = None,
    options: WalkOptions | None = None,
    visits: int = 0,
    threads: int = 1,
) -> Rollouts:
    """Let robots follow a tree, each from its own node and state.

    Args:
        nodes: The tree.
        robot: What moves; without input delay and with a foot that sticks where it lands.
        start: Node at which each begins, on whose leg it stands, shape (B,).
        x: State of each, shape (B, 4); or (B, nx) with the states of effects.
        duration: Time for all or for each in s, in whole samples (rounded up), () or (B,).
        goal: Goal region x' F x <= 1 of each stance leg, shape (2, 4, 4), NaN on a leg without;
            a robot on its way there that is inside at a sample has arrived, and so has one that
            follows an orbit and is in its tube. None: nobody arrives.
        elapsed: Time since the start node at the start in s, shape (B,); None: zero.
        known: The robot as the controller knows it; None: as it is.
        p: Parameter vectors in place of those of `robot`, shape (np,) or (B, np).
        settings: Of the law; its remedy is `event` or `phase`.
        options: Of the simulation; the default samples every 2 ms in one integration step.
        visits: Room for so many visited nodes a rollout.
        threads: Share the rollouts among so many threads; results are the same.

    Raises:
        ValueError: naming what cannot be simulated so.
    """
    law = settings or TrackingSettings()
    how = options or WalkOptions(sample_time=SAMPLE_TIME, step=SAMPLE_TIME)
    legs = STANCES if isinstance(robot.mechanism, CompassGait) else STANCES[:1]
    compiled = [compile_model(robot, Setup(stance=leg)) for leg in legs]
    nominal = parameter_vector(robot, Setup()) if p is None else np.asarray(p, float)
    start = np.ascontiguousarray(start, np.int32)
    count, nl, nx = len(start), nodes.x0.shape[1], compiled[0].nx
    _require_simple(robot, compiled[0], nominal, law, how)
    _expect('p', nominal, (count, compiled[0].np) if nominal.ndim == 2 else (compiled[0].np,))
    if count and not (0 <= start.min() and start.max() < len(nodes)):
        raise ValueError(f'start must hold nodes 0 to {len(nodes) - 1}')
    if goal is not None:
        _expect('goal', goal, (2, nl, nl))
    x = _whole_states(compiled, nodes, np.asarray(x, float), start, nominal)
    _expect('x', x, (count, nx))
    late = np.zeros(count) if elapsed is None else np.array(elapsed, float)
    _expect('elapsed', late, (count,))
    if not (np.isfinite(x).all() and np.isfinite(late).all() and (late >= 0).all()):
        raise ValueError('x and elapsed must be finite numbers, elapsed not negative')
    samples = np.ceil(np.asarray(duration, float) / how.sample_time - 1e-9)
    _expect('duration', samples, (count,) if samples.ndim else ())
    if not ((samples >= 0) & (samples < 2**31)).all():
        raise ValueError('duration must be finite and not negative')
    samples = np.ascontiguousarray(np.broadcast_to(samples, count), np.int32)
    known = known or robot
    job = _Work(nodes, start, x, late, samples, goal, nominal, visits)
    library = rollout_library(robot, known if nodes.compensate else None)
    if library is None:
        job.one_by_one(robot, known, law, how)
    else:
        job.in_lanes(library, compiled[0], known, law, how, threads)
    return job.result()


class _Work:
    """The arrays of one call."""

    def __init__(self, nodes, start, x, elapsed, samples, goal, p, visits: int):
        count, nl = len(start), nodes.x0.shape[1]
        self.nodes, self.goal, self.samples = nodes, goal, samples
        self.p = np.ascontiguousarray(p)
        # C reads rows, whatever order they came in.
        self.x, self.elapsed, self.node = np.array(x, order='C'), elapsed, start.copy()
        self.stance = np.ascontiguousarray(nodes.stance[start], np.int32)
        self.outcome, self.impacts = np.zeros((2, count), np.int32)
        self.time = np.zeros(count)
        self.visited = np.full((count, visits), -1, np.int32)
        self.visit_cost = np.full((count, visits), math.nan)
        self.visit_state = np.full((count, visits, nl), math.nan)

    def result(self) -> Rollouts:
        seen = Visits(self.visited, self.visit_cost, self.visit_state)
        return Rollouts(
            self.outcome, self.x, self.stance, self.time, self.node, self.elapsed, self.impacts,
            seen if self.visited.size else None,
        )  # fmt: skip

    def in_lanes(self, library, compiled: CompiledModel, known, law, how, threads: int) -> None:
        nodes = self.nodes
        forms = None if self.goal is None else triangles(self.goal)
        # C sees addresses only: every array must be held by a name until it returns.
        arrays = {
            'leg': _whole(nodes.stance), 'next': _whole(nodes.next),
            'landing': _whole(nodes.landing), 'late': np.ascontiguousarray(nodes.late),
            'way': np.ascontiguousarray(nodes.ways, np.uint8),
            'span': np.ascontiguousarray(nodes.span), 'edge': nodes.edges,
            'cost': nodes.forms, 'normal': np.ascontiguousarray(nodes.surfaces),
            'known': friction_parameters(known), 'goal': forms, 'p': self.p, 'x': self.x,
            'elapsed': self.elapsed, 'node': self.node, 'stance': self.stance,
            'samples': self.samples,
            'clock': _whole([name in CLOCKS for name in compiled.input_names]),
            'outcome': self.outcome, 'impacts': self.impacts, 'time': self.time,
            'visited': self.visited, 'visit_cost': self.visit_cost,
            'visit_state': self.visit_state,
        }  # fmt: skip
        numbers = {
            'pull': law.pulled, 'fastest': law.fastest, 'limit': known.torque_limit,
            'sample_time': how.sample_time, 'step': min(how.step, compiled.largest_step),
            'fall_angle': how.fall_angle, 'swing_angle': how.swing_angle,
            'minimum_step': how.minimum_step,
            'ahead': -1.0 if how.backwards else 1.0, 'slope': how.slope,
            'p_each': int(self.p.ndim == 2), 'visits': self.visited.shape[1],
            'length_at': dict(zip(compiled.parameter_names, range(compiled.np), strict=True)).get(
                LENGTH, 0
            ),
        }  # fmt: skip
        pointers = {k: None if a is None else a.ctypes.data for k, a in arrays.items()}
        job = _Job(**pointers, **numbers)

        def run(first: int, last: int) -> int:
            return library.cgr_follow(ctypes.byref(job), first, last)

        count = len(self.node)
        if threads <= 1 or count < 2 * WIDTH:
            failed = run(0, count)
        else:
            edges = np.linspace(0, count, threads + 1).astype(int)
            # ctypes lets go of the interpreter while C runs.
            with ThreadPoolExecutor(threads) as pool:
                failed = any(pool.map(run, edges[:-1], edges[1:]))
        if failed:
            raise MemoryError(f'{count} rollouts')

    def one_by_one(self, robot: Model, known: Model, law, how: WalkOptions) -> None:
        """The same without vector code: the simulation of `walk` and the law of `Tracker`."""
        self.hybrid = isinstance(robot.mechanism, CompassGait)
        names = compile_model(robot, Setup()).parameter_names
        for b in range(len(self.node)):
            p = self.p[b] if self.p.ndim == 2 else self.p
            own = robot.with_values(dict(zip(names, p.tolist(), strict=True)))
            tracker = Tracker(self.nodes, known, law, int(self.node[b]))
            tracker.begin(int(self.node[b]), float(self.elapsed[b]))
            self._one(b, _mover(own, how), tracker, how)

    def _one(self, b: int, move: 'Mover', tracker: Tracker, how: WalkOptions) -> None:
        nodes, nl = self.nodes, self.nodes.x0.shape[1]
        leg, x, tick, seen = int(self.stance[b]), self.x[b].copy(), 0, 0
        while not (outcome := self._outcome(b, leg, x, tick, tracker, how)):
            t, node = tick * how.sample_time, tracker.node
            torque = tracker.torque(t, STANCES[leg], x)
            passed = _passed(nodes, node, tracker.node, leg)
            if tick == 0:
                passed = [node, *passed]
            cost = nodes.cost_to_go(tracker.node, tracker.elapsed, x[:nl])
            for place in passed[: self.visited.shape[1] - seen]:
                self.visited[b, seen], self.visit_cost[b, seen] = place, cost
                self.visit_state[b, seen] = x[:nl]
                seen += 1
            try:
                then, x = move(leg, x, torque, t)
            except SimulationError:
                then, x = leg, np.full(len(x), math.nan)
            self.impacts[b] += then != leg
            leg, tick = then, tick + 1
        self.x[b], self.stance[b], self.outcome[b] = x, leg, outcome
        self.time[b] = tick * how.sample_time
        self.node[b], self.elapsed[b] = tracker.node, tracker.elapsed

    def _outcome(self, b: int, leg: int, x, tick: int, tracker: Tracker, how) -> int:
        """An `Outcome`, or zero while the rollout goes on."""
        motion = x[: self.nodes.x0.shape[1]]
        node = tracker.node
        if self.goal is not None and self._arrived(leg, motion, tracker):
            return Outcome.ARRIVED
        swings = self.hybrid and not abs(x[1 - leg]) < how.swing_angle
        if swings or not abs(x[leg]) < how.fall_angle:
            return Outcome.FALLEN
        if self.nodes.stance[node] != leg and self.nodes.landing[node] < 0:
            return Outcome.LEFT
        return Outcome.TIMED_OUT if tick >= self.samples[b] else 0

    def _arrived(self, leg: int, motion: np.ndarray, tracker: Tracker) -> bool:
        node, way = tracker.node, self.nodes.ways[tracker.node]
        if way == Way.UPRIGHT:
            return bool(motion @ self.goal[leg] @ motion <= 1.0)
        on_orbit = way == Way.ORBIT and self.nodes.stance[node] == leg
        return on_orbit and self.nodes.cost_to_go(node, tracker.elapsed, motion) <= 1.0


# (leg, x, torque in N m, instant in s) -> leg and x a sample later.
Mover = Callable[[int, np.ndarray, float, float], tuple[int, np.ndarray]]


def _mover(robot: Model, how: WalkOptions) -> Mover:
    """The motion of a robot over one sample: that of `walk`, or of a machine without feet."""
    if isinstance(robot.mechanism, CompassGait):
        walker = Walker(robot, how, None)
        legs = [walker.stand(stance) for stance in STANCES]

        def walk(leg: int, x, torque: float, t: float):
            then, y = walker.move(legs[leg], x, walker.inputs(torque), how.sample_time, t)
            return STANCES.index(then.stance), y

        return walk
    compiled, p = compile_model(robot, Setup()), parameter_vector(robot, Setup())
    steps = max(1, math.ceil(how.sample_time / min(how.step, compiled.largest_step) - 1e-9))
    h = how.sample_time / steps

    def swing(leg: int, x, torque: float, t: float):
        y, u = x.copy(), np.ones(compiled.nu)
        u[0] = torque
        for k in range(steps):
            compiled.advance(y, stamped(u, compiled.input_names, t + k * h), p, h, 1)
        return leg, y

    return swing


def _passed(nodes: Nodes, node: int, end: int, leg: int) -> list[int]:
    """The nodes that the reference came by on its way, those of a late impact left out."""
    passed = []
    if nodes.stance[node] != leg:
        node = int(nodes.landing[node])
        passed.append(node)
    while node != end:
        node = int(nodes.next[node])
        if not nodes.late[node]:
            passed.append(node)
    return passed


class _Job(ctypes.Structure):
    """`struct job` of rollouts.c."""

    _fields_ = tuple((name, kind) for kind, names in FIELDS.items() for name in names)


def rollout_library(robot: Model, compensated: Model | None) -> ctypes.CDLL | None:
    """The vector code of a robot, built when first needed; None where that cannot be.

    Args:
        robot: Its structure counts.
        compensated: The model whose friction the controller adds; None: it adds none.
    """
    if compiler() is None:
        return None
    key = robot.hash, None if compensated is None else compensated.hash
    if key not in _libraries:
        _libraries[key] = _built(robot, compensated)
    return _libraries[key]


def _built(robot: Model, compensated: Model | None) -> ctypes.CDLL | None:
    try:
        source = rollout_source(robot, compensated)
    except UnsupportedError as error:
        log.warning('rollouts run one by one: %s', error)
        return None
    if source not in _by_source:
        library = ctypes.CDLL(str(shared_library(source, FLAGS)))
        library.cgr_follow.argtypes = [ctypes.POINTER(_Job), ctypes.c_long, ctypes.c_long]
        library.cgr_follow.restype = ctypes.c_int
        _by_source[source] = library
    return _by_source[source]


_libraries: dict[tuple[str, str | None], ctypes.CDLL | None] = {}
_by_source: dict[str, ctypes.CDLL] = {}
_sources: dict[tuple, str] = {}


def rollout_source(robot: Model, compensated: Model | None) -> str:
    """C source of the rollouts of a robot; arguments as in `rollout_library`."""
    hybrid = isinstance(robot.mechanism, CompassGait)
    legs = STANCES if hybrid else STANCES[:1]
    compiled = tuple(compile_model(robot, Setup(stance=leg)) for leg in legs)
    friction = None if compensated is None else friction_torque(compensated)
    key = (*compiled, None if compensated is None else _structure(compensated))
    if key in _sources:
        return _sources[key]
    codes, constants = [], 1
    for number, (leg, own) in enumerate(zip(legs, compiled, strict=True)):
        e = own.equations
        functions = {'': ca.Function('f', [e.x, e.u, e.p], [ca.densify(ca.cse(e.rates))])}
        if hybrid:
            after = impact_function(robot, leg)(e.x[:2], e.x[2:4], e.p)[0]
            functions['land_'] = ca.Function('land', [e.x, e.u, e.p], [ca.densify(ca.cse(after))])
        for name, function in functions.items():
            code, shared = vector_code(
                function, f'{name or "rates_"}{number}', f'prepare_{name}{number}'
            )
            codes.append(code)
            constants = max(constants, shared + 1)
    if friction is not None:
        hip, p, none = ca.SX.sym('a', 2), ca.SX.sym('p', friction.size1_in(2)), ca.SX.sym('u', 0)
        taken = ca.Function('taken', [hip, none, p], [ca.densify(friction(hip[0], hip[1], p))])
        code, shared = vector_code(taken, 'taken', 'prepare_taken')
        codes.append(code)
        constants = max(constants, shared + 1)
    sizes = {
        'WIDTH': WIDTH, 'NX': compiled[0].nx, 'NU': compiled[0].nu, 'NP': compiled[0].np,
        'NL': 2 * compiled[0].equations.coordinates, 'HYBRID': int(hybrid),
        'COMPENSATE': int(friction is not None),
        'NK': 0 if friction is None else friction.size1_in(2), 'CONSTANTS': constants,
        'LEAST_TURN': LEAST_TURN,
    }  # fmt: skip
    _sources[key] = '\n'.join([
        *(f'#define {name} {value}' for name, value in sizes.items()),
        vector_math(),
        *codes,
        (Path(__file__).parent / 'rollouts.c').read_text(),
    ])  # fmt: skip
    return _sources[key]


def _structure(model: Model) -> tuple[tuple[str, ...], ...]:
    return tuple(model.declarations), tuple(effect.label for effect in acting_effects(model))


def _require_simple(robot: Model, compiled: CompiledModel, p: np.ndarray, law, how) -> None:
    """Refuse what only `walk` and `Tracker` can do."""
    if law.by_clock:
        allowed = "remedies are 'event' and 'phase', with feedback"
        raise ValueError(f'remedy is {law.remedy!r}, feedback {law.feedback}; {allowed}')
    if isinstance(robot.mechanism, CompassGait) and not contact_law(robot).plastic:
        raise ValueError(f'a foot of {robot.name!r} does not stick where it lands; use walk')
    if any(compiled.delays(row)[0] for row in np.atleast_2d(p)):
        raise ValueError(f'{robot.name!r} has an input delay; use walk')
    if math.isfinite(how.clearance):
        raise ValueError(f'clearance is {how.clearance} m; feet pass through the ground here')


def _whole_states(compiled, nodes: Nodes, x: np.ndarray, start: np.ndarray, p) -> np.ndarray:
    """Start states with those of the effects, at rest."""
    motion = nodes.x0.shape[1]
    if x.ndim != 2 or x.shape[1] != motion or compiled[0].nx == motion:
        return x
    u = np.ones(compiled[0].nu)
    u[0] = 0.0
    rows = p if p.ndim == 2 else [p] * len(x)
    return np.array([
        compiled[leg].initial_state(one, u, row)
        for one, leg, row in zip(x, nodes.stance[start], rows, strict=True)
    ])  # fmt: skip


def _whole(values) -> np.ndarray:
    return np.ascontiguousarray(values, np.int32)


def _expect(name: str, array: np.ndarray, shape: tuple[int, ...]) -> None:
    if np.shape(array) != shape:
        raise ValueError(f'{name} has shape {np.shape(array)}, expected {shape}')
