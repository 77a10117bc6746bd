"""Direct collocation of a hybrid motion as a sparse program, compiled once per structure.

Hermite-Simpson as in Hargraves and Paris 1987 (the thesis's "DIRCOL"): with knots k, step h = T/n,
rates r = (v, a) and the slope and value of the cubic at the middle of an interval,

    x_c = (x + x+)/2 + h/8 (r - r+),   a_c = 3/(2h) (v+ - v) - (a + a+)/4          (HS)
    q+ - q = h/6 (v + 4 v_c + v+)
    M(q) a + b(q, v) = Q(u)   at each knot and in the middle, u_c = (u + u+)/2      (ID)

Accelerations a are unknowns, so that no M^-1 is ever differentiated: same solution as with
dx/dt = f(x, u), a tenth of the operations in second derivatives. Between phases stands the impact
map (IMP). Phase durations T are unknowns.

The program has the shape of an optimal control problem, so that fatrop factors it stage by stage,
in time linear in n: the state of a stage is its knot (x, a, u) and T, its control the next knot,

    s+ = (w, T),   g(s, w) = 0  or within bounds.                                    (OCP)

Each stage enters Jacobian and Hessian of the Lagrangian as one dense block; the blocks come from
one symbolic expression per mode, mapped over the stages. Nearly all of the generated C is in them,
and they know nothing of how many intervals there are or what else the program consists of: each is
compiled once, for coarse, fine and elastic programs alike, and linked.
"""

import functools
import logging
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import casadi as ca
import numpy as np

from cg_control.friction import friction_torque
from cg_dynamics.assemble import acting_effects, assemble, parameter_names
from cg_dynamics.mechanisms.compass_gait import CompassGait
from cg_dynamics.model import Model
from cg_dynamics.rig import STANCES, Setup
from cg_dynamics.rollout.compiler import FLAGS, compiler, object_file, shared_library
from cg_dynamics.walking.hybrid import other
from cg_dynamics.walking.impact import impact_function

log = logging.getLogger(__name__)

KNOT = 7  # q (2), v (2), a (2), u
# Units of the variables: rad, 10 rad/s, 100 rad/s^2, 100 N m. In SI a torque moves an angle within
# a step by 1e-5, which is fatrop's pivot tolerance: it then takes rows for dependent or, worse,
# nearly dependent ones for good and regularises without end.
UNITS = np.array([1.0, 1.0, 10.0, 10.0, 100.0, 100.0, 100.0])
MEMORY_UNITS = UNITS[:4]
TORQUE_SCALE = 100.0  # N m; brings (ID) to the size of the other rows
RATE_SCALE = 100.0  # N m/s
CLEARANCE_WIDTH = 0.01  # m of reach over which a retracted foot comes down
TASK_PARAMETERS = ('slope', 'effort', 'time', 'retraction', 'reach', 'approach', 'farthest')
PIECES = 24  # of a stretch
EDGE = 20  # numbers of a piece: 4 powers of 4 states and of the cost to go
# Bounds; center and form; instants and edges of the pieces; the same and form.
GOAL_PARAMETERS = {
    'box': 8, 'region': 20, 'stretch': PIECES * (1 + EDGE), 'tube': PIECES * (1 + EDGE) + 16
}  # fmt: skip
MISS_SCALE = np.array([0.1, 0.1, 0.3, 0.3])  # rad, rad/s: misses of the goal worth the same
# Long straight-line code: higher levels take minutes to compile it and gain nothing.
FLAGS_HERE = tuple(flag for flag in FLAGS if flag != '-ftree-vectorize')


@dataclass(frozen=True)
class Structure:
    """What a compiled program depends on, beside the structure of the model.

    Attributes:
        modes: Stance leg of each phase.
        intervals: Of each phase.
        periodic: The motion ends with an impact after which it begins anew; with an odd number of
            phases the legs then change places, which makes sense for two equal leg pairs.
        rate_limited: Rows for the rate of the torque.
        clearance: Rows that keep the swing foot above the ground, or its retraction below.
        clocked: A row for the duration of the whole motion; stages carry what earlier phases took.
        goal: 'box', 'region' (an ellipsoid), 'stretch' (any point of a branch) or 'tube' (any
            point of an ellipsoid around one).
        elastic: Goal and landing are no conditions; the cost is how far they are missed. Such a
            program always has a solution, and says whether the strict one has.
        given_back: Labels of friction effects whose torque the motor gives on top of u: they are
            no part of the dynamics, and rows keep u and that torque together within the limit.
    """

    modes: tuple[str, ...]
    intervals: tuple[int, ...]
    periodic: bool = False
    rate_limited: bool = False
    clearance: bool = False
    clocked: bool = False
    goal: str = 'box'
    elastic: bool = False
    given_back: tuple[str, ...] = ()

    def __post_init__(self):
        for mode in self.modes:
            if mode not in STANCES:
                raise ValueError(f'modes: {mode!r} is not one of {", ".join(STANCES)}')
        for before, after in zip(self.modes, self.modes[1:], strict=False):
            if before == after:
                raise ValueError(f'modes: {before!r} twice in a row; an impact changes the leg')
        if len(self.intervals) != len(self.modes) or not self.modes:
            raise ValueError('modes and intervals must have the same number of entries')
        if self.goal not in GOAL_PARAMETERS:
            raise ValueError(f'goal: {self.goal!r} is not one of {", ".join(GOAL_PARAMETERS)}')
        if min(self.intervals) < 2:
            raise ValueError(f'intervals are {self.intervals}; each phase needs at least 2')


# Name, expression, lower and upper bound.
Row = tuple[str, Any, float, float]


@dataclass(frozen=True)
class Block:
    """The rows of one kind of stage: f(s, w, p), where s is the state and w the control.

    Here p is that of the program and, last, the number of intervals of the phase.

    Attributes:
        function: (z, p) -> rows, cost; z = (s, w).
        jacobian: (z, p) -> d rows/dz, dense.
        hessian: (z, p, cost factor, multipliers) -> second derivative of the Lagrangian, dense.
        gradient: (z, p) -> gradient of the cost.
        lower: Bounds of the rows, NaN where the task sets them.
        upper: As `lower`.
        names: Of the rows.
    """

    function: ca.Function
    jacobian: ca.Function
    hessian: ca.Function
    gradient: ca.Function
    lower: np.ndarray
    upper: np.ndarray
    names: tuple[str, ...]

    @property
    def functions(self) -> tuple[ca.Function, ...]:
        """Rows, Jacobian, Hessian and gradient."""
        return self.function, self.jacobian, self.hessian, self.gradient

    def compiled(self) -> tuple['Block', Path]:
        """The block as machine code, from the cache if it is known, and its object file."""
        name = self.function.name().removesuffix('_f')  # what is linked together needs its own
        generator = ca.CodeGenerator(name, {'with_header': False})
        for function in self.functions:
            generator.add(function)
        code = object_file(generator.dump(), FLAGS_HERE)
        library = str(shared_library('', FLAGS_HERE, [code]))
        f, j, h, g = (ca.external(function.name(), library) for function in self.functions)
        return replace(self, function=f, jacobian=j, hessian=h, gradient=g), code

    def and_start(self, start: 'Block') -> 'Block':
        """This stage with rows of its state alone besides."""
        z, p = ca.MX.sym('z', self.function.size1_in(0)), ca.MX.sym('p', self.function.size1_in(1))
        nx, own = start.function.size1_in(0), len(self.names)
        factor, multipliers = ca.MX.sym('factor'), ca.MX.sym('lam', own + len(start.names))
        controls = z.shape[0] - nx
        state = z[:nx]
        rows, cost = self.function(z, p)
        beside = ca.DM.zeros(len(start.names), controls)
        jacobian = ca.vertcat(self.jacobian(z, p), ca.horzcat(start.jacobian(state, p), beside))
        bent = start.hessian(state, p, factor, multipliers[own:])
        hessian = self.hessian(z, p, factor, multipliers[:own]) + ca.diagcat(
            bent, ca.DM.zeros(controls, controls)
        )
        return Block(
            ca.Function('first_f', [z, p], [ca.vertcat(rows, start.function(state, p)[0]), cost]),
            ca.Function('first_j', [z, p], [jacobian]),
            ca.Function('first_h', [z, p, factor, multipliers], [ca.densify(hessian)]),
            self.gradient,
            np.concatenate([self.lower, start.lower]),
            np.concatenate([self.upper, start.upper]),
            (*self.names, *start.names),
        )


@dataclass(frozen=True)
class Run:
    """Stages of one kind in a row.

    Attributes:
        block: Their rows.
        count: How many they are.
        kind: 'knot' where dynamics to the next stage are s+ = (w, T), 'jump' or 'last'.
        intervals: Of the phase.
        start: Rows besides, of the state alone.
    """

    block: Block
    count: int
    kind: str
    intervals: int
    start: Block | None = None

    @property
    def whole(self) -> Block:
        """All rows of a stage."""
        return self.block.and_start(self.start) if self.start else self.block

    @property
    def blocks(self) -> tuple[Block, ...]:
        """What it is made of."""
        return (self.block, self.start) if self.start else (self.block,)

    def of(self, made: dict[str, Block]) -> 'Run':
        """The same run of other functions, by the name of what they stand for."""
        start = self.start and made[self.start.function.name()]
        return replace(self, block=made[self.block.function.name()], start=start)


def _block(name: str, z: ca.SX, p: ca.SX, rows: list[Row], cost) -> Block:
    expressions = ca.vertcat(*(row[1] for row in rows)) if rows else ca.SX(0, 1)
    names = [row[0] for row in rows for _ in range(ca.SX(row[1]).shape[0])]
    lower = [row[2] for row in rows for _ in range(ca.SX(row[1]).shape[0])]
    upper = [row[3] for row in rows for _ in range(ca.SX(row[1]).shape[0])]
    factor, multipliers = ca.SX.sym('factor'), ca.SX.sym('multipliers', expressions.shape[0])
    lagrangian = factor * cost + ca.dot(multipliers, expressions)
    hessian = ca.hessian(lagrangian, z)[0]

    def function(suffix, arguments, *results):
        dense = list(ca.cse([ca.densify(result) for result in results]))
        return ca.Function(f'cgt_{name}_{suffix}', arguments, dense)

    return Block(
        function('f', [z, p], expressions, ca.SX(cost)),
        function('j', [z, p], ca.jacobian(expressions, z)),
        function('h', [z, p, factor, multipliers], hessian),
        function('g', [z, p], ca.gradient(ca.SX(cost), z)),
        np.array(lower),
        np.array(upper),
        tuple(names),
    )


class Transcription:
    """A hybrid motion as a compiled program for fatrop.

    Attributes:
        structure: What it was made for.
        parameter_count: Length of the parameter vector: model, task, goal.
        units: Of the state of a stage, shape (nx,); its control is in UNITS.
        slides: The last stage has one control: how far along a stretch the motion ends, s.
        names: Name of each row of g, '' for the dynamics of stages.
        lower: Bounds of the rows of g; those of inequalities are set by the task.
        upper: As `lower`.
    """

    def __init__(self, model: Model, structure: Structure):
        if not isinstance(model.mechanism, CompassGait):
            raise ValueError(f'motions are planned for a compass gait, not {model.mechanism.name}')
        self.structure = structure
        self.memory = 4 if structure.periodic else 0
        clock = [1.0] * structure.clocked
        self.nx = KNOT + 1 + self.memory + len(clock)
        self.units = np.concatenate([UNITS, [1.0], MEMORY_UNITS[: self.memory], clock])
        self.names_of_model = parameter_names(model, Setup())
        self.model_parameters = len(self.names_of_model)
        self.slides = structure.goal in ('stretch', 'tube')
        goal = GOAL_PARAMETERS[structure.goal]
        self.parameter_count = self.model_parameters + len(TASK_PARAMETERS) + goal
        self._symbols = ca.SX.sym('p', self.parameter_count + 1)
        # All but what the last block alone needs.
        self._shared = ca.vertcat(self._symbols[: self.parameter_count - goal], self._symbols[-1])
        self._model, rubbing = model, model
        for effect in model.effects:
            if effect.label in structure.given_back:
                self._model = self._model.without_effect(effect.label)
            elif effect.friction:
                rubbing = rubbing.without_effect(effect.label)
        self._rubbing = rubbing if structure.given_back else None
        self._build()

    # Symbols

    def _parameters(self) -> tuple[ca.SX, dict[str, ca.SX]]:
        task = self._symbols[self.model_parameters : -1]
        self._goal = task[len(TASK_PARAMETERS) :]
        named = dict(zip(TASK_PARAMETERS, ca.vertsplit(task[: len(TASK_PARAMETERS)]), strict=True))
        return self._symbols[: self.model_parameters], named

    def _parameters_of(self, model: Model) -> ca.SX:
        """The parameters of a model that has some effects less."""
        at = [self.names_of_model.index(name) for name in parameter_names(model, Setup())]
        return self._symbols[: self.model_parameters][at]

    def _motor(self, x: ca.SX, u: ca.SX) -> list[Row]:
        """Rows for the torque of the motor, which gives back friction beside u."""
        if self._rubbing is None:
            return []
        p = self._parameters_of(self._rubbing)
        taken = friction_torque(self._rubbing)(x[0] - x[1], x[2] - x[3], p)
        return [('motor', (u + taken) / TORQUE_SCALE, np.nan, np.nan)]

    def _physical(self, scaled: Any) -> Any:
        """The state of a stage in SI units."""
        return ca.DM(self.units) * scaled

    def _inverse_dynamics(self, mode: str):
        e = assemble(self._model, Setup(stance=mode))
        if e.x.shape[0] != 4 or e.u.shape[0] != 1:
            raise ValueError(
                'motions are planned in four states and one torque; leave out effects with extra '
                'states or inputs (collocation.planning_model)'
            )
        a = ca.SX.sym('a', 2)
        residual = (ca.mtimes(e.mass_matrix, a) - e.load) / TORQUE_SCALE
        return ca.Function('id', [e.x, a, e.u, e.p], [ca.cse(residual)])

    def _foot(self, q: ca.SX, v: ca.SX, mode: str) -> tuple[ca.SX, ca.SX, ca.SX]:
        """Height of the swing foot above the ground, its rate, and its reach: (GUARD)."""
        p, task = self._parameters()
        l = p[parameter_names(self._model, Setup()).index('leg_length')]
        st, sw = (0, 1) if mode == 'inner' else (1, 0)
        tangent = ca.tan(task['slope'])
        reach = l * (ca.sin(q[st]) - ca.sin(q[sw]))
        height = l * (ca.cos(q[st]) - ca.cos(q[sw])) + reach * tangent
        return height, ca.jtimes(height, q, v), reach

    def _stage(self, mode: str) -> Block:
        scaled = ca.SX.sym('z', self.nx + KNOT)
        s, w = self._physical(scaled[: self.nx]), ca.DM(UNITS) * scaled[self.nx :]
        _, task = self._parameters()
        p, dynamics = self._parameters_of(self._model), self._inverse_dynamics(mode)
        x, a, u, T = s[:4], s[4:6], s[6], s[7]
        x_next, a_next, u_next = w[:4], w[4:6], w[6]
        h = T / self._symbols[-1]
        x_c = (x + x_next) / 2 + h / 8 * (ca.vertcat(x[2:], a) - ca.vertcat(x_next[2:], a_next))
        a_c = 1.5 / h * (x_next[2:] - x[2:]) - (a + a_next) / 4
        move = x_next[:2] - x[:2] - h / 6 * (x[2:] + 4 * x_c[2:] + x_next[2:])
        rows = [
            ('collocation', move, 0.0, 0.0),
            ('collocation', dynamics(x_c, a_c, (u + u_next) / 2, p), 0.0, 0.0),
            ('dynamics', dynamics(x_next, a_next, u_next, p), 0.0, 0.0),
        ]
        rows += self._motor(x_next, u_next)
        if self.structure.rate_limited:
            rows.append(('rate', (u_next - u) / h / RATE_SCALE, np.nan, np.nan))
        if self.structure.clearance:
            q, v = ca.SX.sym('q', 2), ca.SX.sym('v', 2)
            height, _, reach = self._foot(q, v, mode)
            down = 1 / (1 + ca.exp((reach - 2 * CLEARANCE_WIDTH) / (CLEARANCE_WIDTH / 4)))
            room = ca.substitute(height + task['retraction'] * down, q, x_next[:2])
            rows.append(('clearance', room * 10, 0.0, np.inf))
        effort = h / 2 * (u**2 + u_next**2)
        cost = task['effort'] * effort + task['time'] * h
        return _block(f'stage_{mode}', scaled, self._shared, rows, cost)

    def _start(self, mode: str) -> Block:
        """What the first knot must keep besides: nothing before it does."""
        scaled = ca.SX.sym('z', self.nx)
        s, p = self._physical(scaled), self._parameters_of(self._model)
        rows: list[Row] = [
            ('dynamics', self._inverse_dynamics(mode)(s[:4], s[4:6], s[6], p), 0.0, 0.0)
        ]
        rows += self._motor(s[:4], s[6])
        if self.memory:
            rows.append(('memory', (s[8:12] - s[:4]) / MEMORY_UNITS, 0.0, 0.0))
        if self.structure.clocked:
            rows.append(('memory', s[-1], 0.0, 0.0))
        return _block(f'start_{mode}', scaled, self._shared, rows, 0)

    def _landing(self, s: ca.SX, mode: str):
        q, v = ca.SX.sym('q', 2), ca.SX.sym('v', 2)
        task = self._parameters()[1]
        height, rate, reach = ca.substitute([*self._foot(q, v, mode)], [q, v], [s[:2], s[2:4]])
        rows = [
            ('landing', height * 10, 0.0, 0.0),
            ('approach', -rate - task['approach'], 0.0, np.inf),
            ('reach', reach - task['reach'], 0.0, np.inf),
        ]
        miss: Any = 0
        if self.structure.elastic:
            (_, height, *_), (_, approach, *_), (_, reach, *_) = rows
            beyond = ca.fmax(reach + task['reach'] - task['farthest'], 0)
            near = ca.fmin(reach, 0) ** 2 + beyond**2
            miss = height**2 + ca.fmin(approach, 0) ** 2 + 100 * near
            rows = []
        p = self._parameters_of(self._model)
        v_plus = impact_function(self._model, mode)(s[:2], s[2:4], p)[0]
        return v_plus, rows, miss

    def _jump(self, mode: str) -> Block:
        # Control: what is new after the impact, (a, u, T).
        scaled = ca.SX.sym('z', self.nx + 4)
        s = self._physical(scaled[: self.nx])
        w = ca.DM([*UNITS[4:], 1.0]) * scaled[self.nx :]
        p = self._parameters_of(self._model)
        v_plus, rows, miss = self._landing(s, mode)
        after = self._inverse_dynamics(other(mode))(ca.vertcat(s[:2], v_plus), w[:2], w[2], p)
        rows.append(('dynamics', after, 0.0, 0.0))
        rows += self._motor(ca.vertcat(s[:2], v_plus), w[2])
        # The next state enters linearly; the rows of the gap come first and hold it back.
        carried = scaled[8 : self.nx]
        if self.structure.clocked:
            carried[-1] += s[7]
        gap = ca.vertcat(s[:2], v_plus / UNITS[2:4], scaled[self.nx :], carried)
        rows = [('', gap, 0.0, 0.0), *rows]
        return _block(f'jump_{mode}', scaled, self._shared, rows, miss)

    def _last(self, mode: str) -> Block:
        scaled = ca.SX.sym('z', self.nx + self.slides)
        s = self._physical(scaled[: self.nx])
        rows: list[Row] = []
        miss: Any = 0
        cost: Any = 0
        self._parameters()
        if self.structure.periodic:
            v_plus, rows, miss = self._landing(s, mode)
            swap = [1, 0] if len(self.structure.modes) % 2 else [0, 1]
            image = ca.vertcat(s[swap], v_plus[swap])
            if self.structure.elastic:
                miss += ca.sumsqr((image - s[8:12]) / MISS_SCALE)
            else:
                rows.append(('periodicity', (image - s[8:12]) / MEMORY_UNITS, 0.0, 0.0))
        if self.structure.clocked:
            rows.append(('total', s[-1] + s[7], np.nan, np.nan))
        goal = self.structure.goal
        if goal != 'box':
            center = self._goal[:4]
            if self.slides:
                center, cost = self._slid(scaled[self.nx])
            e = s[:4] - center
        if goal == 'stretch':
            if self.structure.elastic:
                miss += ca.sumsqr(e / MISS_SCALE)
            else:
                rows.append(('meeting', e / UNITS[:4], 0.0, 0.0))
        elif goal != 'box':
            form = ca.dot(e, ca.mtimes(ca.reshape(self._goal[-16:], 4, 4), e))
            if self.structure.elastic:
                miss += ca.fmax(form - 1, 0) ** 2
            else:
                rows.append(('region', form, -np.inf, 1.0))
        elif self.structure.elastic:
            below, above = self._goal[:4] - s[:4], s[:4] - self._goal[4:]
            miss += ca.sumsqr(ca.fmax(ca.fmax(below, above), 0) / MISS_SCALE)
        return _block(f'last_{mode}', scaled, self._symbols, rows, miss + cost)

    def _slid(self, s: ca.SX) -> tuple[ca.SX, ca.SX]:
        """State and cost to go at s along the stretch: of the last piece that began before."""
        start = self._goal[:PIECES]
        edges = ca.reshape(self._goal[PIECES : PIECES * (1 + EDGE)], EDGE, PIECES)
        since, edge = start[0], edges[:, 0]
        for k in range(1, PIECES):
            later = s >= start[k]
            since = ca.if_else(later, start[k], since)
            edge = ca.if_else(later, edges[:, k], edge)
        t = s - since
        value = ca.mtimes(ca.reshape(edge, 5, 4), ca.vertcat(1, t, t**2, t**3))
        return value[:4], value[4]

    # The program

    def _build(self) -> None:
        s = self.structure
        stages = {mode: self._stage(mode) for mode in dict.fromkeys(s.modes)}
        jumps = {mode: self._jump(mode) for mode in dict.fromkeys(s.modes[:-1])}
        runs: list[Run] = []
        for i, (mode, n) in enumerate(zip(s.modes, s.intervals, strict=True)):
            if i == 0:
                runs.append(Run(stages[mode], 1, 'knot', n, self._start(mode)))
            runs.append(Run(stages[mode], n - 1 if i == 0 else n, 'knot', n))
            if i < len(s.modes) - 1:
                runs.append(Run(jumps[mode], 1, 'jump', n))
            else:
                runs.append(Run(self._last(mode), 1, 'last', n))
        self._runs = runs
        self._nx, self._nu, self._ng = [], [], []
        lower: list[float] = []
        upper: list[float] = []
        names: list[str] = []
        for run in runs:
            block, count, kind = run.whole, run.count, run.kind
            gap = 0 if kind == 'last' else self.nx
            controls = block.function.size1_in(0) - self.nx
            own = len(block.names) - (gap if kind == 'jump' else 0)
            for _ in range(count):
                self._nx.append(self.nx)
                self._nu.append(controls)
                self._ng.append(own)
                fill = self.nx if kind == 'knot' else 0
                lower += [0.0] * fill + list(block.lower)
                upper += [0.0] * fill + list(block.upper)
                names += [''] * fill + list(block.names)
        self.names = tuple(names)
        self.lower, self.upper = np.array(lower), np.array(upper)
        self.rows_of = {
            name: np.flatnonzero([other_name == name for other_name in names])
            for name in dict.fromkeys(names)
        }
        sizes = np.add(self._nx, self._nu)
        self.offsets = np.concatenate([[0], np.cumsum(sizes)])
        self.size = int(self.offsets[-1])

    def _assembled(self, runs: Sequence[Run]) -> list[ca.Function]:
        """The functions of the program: f, g, gradient, Jacobian, Hessian, under their names."""
        z: Any = ca.MX.sym('x', self.size)
        p: Any = ca.MX.sym('p', self.parameter_count)
        lam_f: Any = ca.MX.sym('lam_f')
        lam_g: Any = ca.MX.sym('lam_g', len(self.names))
        f: Any = 0
        g: Any = []
        gradient: Any = []
        hessian_parts: list[Any] = []
        jacobian_parts: list[Any] = []
        rows_j: list[np.ndarray] = []
        cols_j: list[np.ndarray] = []
        rows_h: list[np.ndarray] = []
        cols_h: list[np.ndarray] = []
        constants: list[tuple[int, int, float]] = []
        column, row = 0, 0
        for run in runs:
            block, count, kind = run.whole, run.count, run.kind
            width, own = block.function.size1_in(0), len(block.names)
            fill = self.nx if kind == 'knot' else 0
            height = fill + own
            Z = ca.reshape(z[column : column + count * width], width, count)
            L = ca.reshape(lam_g[row : row + count * height], height, count)[fill:, :]
            shared = block.function.size1_in(1) - 1
            P = ca.repmat(ca.vertcat(p[:shared], run.intervals), 1, count)
            mapped = [fn if count == 1 else fn.map(count) for fn in block.functions]
            values, cost = mapped[0](Z, P)
            f += ca.sum2(cost)
            if kind == 'knot':
                # s+ - (w, T, memory) = 0, where s+ begins the next column.
                states = ca.horzcat(
                    *([Z[: self.nx, 1:]] if count > 1 else []),
                    z[column + count * width : column + count * width + self.nx],
                )
                gap = states - ca.vertcat(Z[self.nx :, :], Z[KNOT : self.nx, :])
                g.append(ca.vec(ca.vertcat(gap, values)))
            elif kind == 'jump':
                signs = ca.vertcat(-ca.DM.ones(self.nx), ca.DM.ones(own - self.nx))
                following = z[column + width : column + width + self.nx]
                shift = ca.vertcat(following, ca.DM.zeros(own - self.nx))
                g.append(shift + signs * values)
                L = L * signs
            else:
                g.append(values)
            gradient.append(ca.vec(mapped[3](Z, P)))
            J = ca.reshape(mapped[1](Z, P), own, width * count)
            H = mapped[2](Z, P, ca.repmat(lam_f, 1, count), L)
            if kind == 'jump':
                J = ca.repmat(signs, 1, width) * J
            jacobian_parts.append(ca.vec(J))
            hessian_parts.append(ca.vec(H))
            for k in range(count):
                c0, r0 = column + k * width, row + k * height
                inner, outer = np.meshgrid(np.arange(own), np.arange(width))
                rows_j.append((r0 + fill + inner).ravel())
                cols_j.append((c0 + outer).ravel())
                inner, outer = np.meshgrid(np.arange(width), np.arange(width))
                rows_h.append((c0 + inner).ravel())
                cols_h.append((c0 + outer).ravel())
                if kind != 'last':
                    constants += [(r0 + i, c0 + width + i, 1.0) for i in range(self.nx)]
                if kind == 'knot':
                    sources = [*range(self.nx, self.nx + KNOT), *range(KNOT, self.nx)]
                    constants += [(r0 + i, c0 + j, -1.0) for i, j in enumerate(sources)]
            column, row = column + count * width, row + count * height
        jacobian = _scattered(
            (len(self.names), self.size),
            np.concatenate([*rows_j, [c[0] for c in constants]]).astype(int),
            np.concatenate([*cols_j, [c[1] for c in constants]]).astype(int),
            ca.vertcat(*jacobian_parts, ca.DM([c[2] for c in constants])),
        )
        hessian = _scattered(
            (self.size, self.size),
            np.concatenate(rows_h),
            np.concatenate(cols_h),
            ca.vertcat(*hessian_parts),
        )
        g, gradient_f = ca.vertcat(*g), ca.vertcat(*gradient)
        gamma = lam_f * gradient_f + ca.mtimes(jacobian.T, lam_g)
        return [
            ca.Function('nlp', [z, p], [f, g], ['x', 'p'], ['f', 'g']),
            ca.Function('nlp_f', [z, p], [f], ['x', 'p'], ['f']),
            ca.Function('nlp_g', [z, p], [g], ['x', 'p'], ['g']),
            ca.Function('nlp_grad_f', [z, p], [gradient_f], ['x', 'p'], ['grad_f_x']),
            ca.Function('nlp_jac_g', [z, p], [g, jacobian], ['x', 'p'], ['g', 'jac_g_x']),
            ca.Function(
                'nlp_hess_l', [z, p, lam_f, lam_g], [gamma, hessian],
                ['x', 'p', 'lam_f', 'lam_g'], ['grad_gamma_x', 'hess_gamma_x_x'],
            ),
            ca.Function(
                'nlp_grad', [z, p, lam_f, lam_g], [f, g, gamma, ca.MX.zeros(p.shape)],
                ['x', 'p', 'lam_f', 'lam_g'], ['f', 'g', 'grad_gamma_x', 'grad_gamma_p'],
            ),
        ]  # fmt: skip

    def functions(self) -> dict[str, ca.Function]:
        """The functions of the program by name, interpreted: for tests."""
        return {function.name(): function for function in self._assembled(self._runs)}

    @functools.cached_property
    def _program(self) -> Any:
        """What nlpsol takes: the compiled program, or its symbols where there is no compiler."""
        if compiler() is None:
            log.warning('no C compiler found: planning runs on the CasADi virtual machine, slower')
            z, p = ca.MX.sym('x', self.size), ca.MX.sym('p', self.parameter_count)
            f, g = self._assembled(self._runs)[0](z, p)
            return {'x': z, 'p': p, 'f': f, 'g': g}
        made, objects = {}, []
        blocks = {b.function.name(): b for run in self._runs for b in run.blocks}
        for name, block in blocks.items():
            made[name], code = block.compiled()
            objects.append(code)
        generator = ca.CodeGenerator('cgt', {'with_header': False})
        for function in self._assembled([run.of(made) for run in self._runs]):
            generator.add(function)
        return str(shared_library(generator.dump(), FLAGS_HERE, objects))

    def solver(
        self, iterations: int, tolerance: float, equality: np.ndarray, points: bytes = b''
    ) -> ca.Function:
        """Fatrop on the compiled program.

        Args:
            iterations: At most.
            tolerance: Of rows and optimality.
            equality: Which rows have equal bounds, shape (ng,).
            points: Which variables have equal bounds. The interface takes note of them at the
                first call and never again, so that each pattern needs a solver of its own.
        """
        key = (iterations, tolerance, equality.tobytes(), points)
        if key not in self._solvers:
            self._solvers[key] = ca.nlpsol(
                'cgt', 'fatrop', self._program,
                {
                    'print_time': False, 'structure_detection': 'manual',
                    'N': len(self._nx) - 1, 'nx': self._nx, 'nu': self._nu, 'ng': self._ng,
                    'equality': equality.tolist(), 'error_on_fail': False,
                    'fatrop': {
                        'print_level': 0, 'max_iter': iterations, 'tol': tolerance,
                    },
                },
            )  # fmt: skip
        return self._solvers[key]

    @functools.cached_property
    def _solvers(self) -> dict[tuple[int, float, bytes, bytes], ca.Function]:
        return {}


def _scattered(shape: tuple[int, int], rows: np.ndarray, cols: np.ndarray, values) -> Any:
    """A sparse matrix from its nonzeros in any order."""
    order = np.lexsort((rows, cols))
    starts = np.concatenate([[0], np.cumsum(np.bincount(cols, minlength=shape[1]))])
    sparsity = ca.Sparsity(shape[0], shape[1], starts.tolist(), rows[order].tolist())
    return ca.MX(sparsity, values[order.tolist()])


_made: dict[tuple, Transcription] = {}


def transcribe(model: Model, structure: Structure) -> Transcription:
    """The program of a model's structure; quick when it was built before in this process."""
    key = (
        model.mechanism.name,
        tuple((e.name, e.at) for e in model.effects),
        tuple(e.label for e in acting_effects(model)),
        structure,
    )
    if key not in _made:
        _made[key] = Transcription(model, structure)
    return _made[key]
