"""The simulation error of many records and its normal equations: theory.md, (ID).

One evaluation simulates every data set with exact sensitivities and adds up the normal equations.
Each data set's own unknowns, its initial motion, couple to the shared parameters only, so that a
Schur complement leaves a system as small as the number of parameters, however many records. Where
data sets are pieces of one recording and share something of its own, they are eliminated together.
"""

import functools
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field, replace

import casadi as ca
import numpy as np

from cg_dynamics.assemble import parameter_vector
from cg_dynamics.model import Model
from cg_dynamics.rollout.compiled import CompiledModel, Judged, Normal, compile_model
from cg_sysid.identification.company import in_company
from cg_sysid.identification.data_set import DataSet
from cg_sysid.identification.unknowns import Unknown, awake, own_unknowns, unsettled_states
from cg_sysid.parallel import side_by_side

RUNAWAY = 1e60
LOST = 1e-30  # curvature beside the steepest one, below which there is none
SPOILT = 1.1  # times what a block did cost: more, and one squared sigma, is a step led astray
FEW = 0.25  # share of the blocks, up to which it is they that are astray and not the step
SETTLING_STEPS = 4  # of a block by itself
SETTLING_DAMPING = 1e-3  # of the first of them
BARRIER = 1e-2  # weight of the physical-consistency barrier, in units of one squared sigma


@dataclass
class Problem:
    """Compiled models and constants of one fit.

    What a data set has of its own is one vector: its initial motion, how far extra states are from
    settled at its start (`unsettled_states`, in their spreads), then the values of
    `own_unknowns`; `blocks` say what is eliminated together. It is believed to lie at
    `guesses`, give or take `spreads` (`spread`). `refinement` integration steps are taken in
    place of one. Models of first looks are compiled in `company` of other effects.
    """

    model: Model
    data_sets: Sequence[DataSet]
    unknowns: tuple[Unknown, ...]
    guesses: Sequence[np.ndarray]
    refinement: float = 1.0
    company: bool = False
    spreads: list[np.ndarray] = field(default_factory=list)
    own: tuple[Unknown, ...] = ()
    blocks: tuple['Block', ...] = ()
    compiled: list[CompiledModel] = field(default_factory=list)
    vectors: list[np.ndarray] = field(default_factory=list)
    places: list[np.ndarray] = field(default_factory=list)
    own_places: list[np.ndarray] = field(default_factory=list)
    starts: list[np.ndarray] = field(default_factory=list)
    columns: list[np.ndarray] = field(default_factory=list)
    inputs: list[np.ndarray] = field(default_factory=list)
    evaluations: int = 0

    def __post_init__(self):
        names = tuple(u.name for u in self.unknowns)
        self.own = own_unknowns(self.model)
        unsettled = unsettled_states(self.model)
        own = [u.name for u in self.own]
        acting, resting = in_company(self.model) if self.company else (self.model, self.model)
        default = compile_free(acting, names)
        model = awake(acting)
        for data_set in self.data_sets:
            compiled = compile_model(model, data_set.setup, default)
            m2 = 2 * compiled.equations.coordinates
            order = [*unsettled, *own, *names]
            self.spreads.append(
                np.concatenate(
                    [
                        data_set.motion_sigma,
                        np.ones(len(unsettled)),
                        [u.tolerance for u in self.own],
                    ]
                )
            )
            at = [m2 + unsettled.index(s) for s in compiled.state_names[m2:]]
            self.starts.append(np.concatenate([np.arange(m2), at]).astype(int))
            self.own_places.append(np.array([compiled.parameter_names.index(n) for n in own], int))
            self.compiled.append(compiled)
            self.inputs.append(data_set.inputs_for(compiled.input_names))
            self.vectors.append(parameter_vector(resting, data_set.setup))
            self.places.append(np.array([compiled.parameter_names.index(n) for n in names], int))
            self.columns.append(
                np.array([m2 + order.index(f) if f in order else -1 for f in compiled.free], int)
            )
        self.consistency = _consistency(self.model, names)
        self.blocks = _blocks(self.data_sets, self.own, len(unsettled))
        shared = np.array([u.each == 'recording' for u in self.own], bool)
        for block in self.blocks:
            for i in block.data_sets[1:]:
                # What a recording has of its own is believed once.
                self.spreads[i][len(self.spreads[i]) - len(shared) :][shared] = np.inf

    def spread(self, i: int, weight: float) -> np.ndarray:
        """How far what data set i has of its own may lie from its first guess.

        The guess of a motion was made from the same data and weighs as they do: a simulation that
        is wrong starts as far from where the machine did as it goes on.
        """
        scale = np.ones(len(self.spreads[i]))
        scale[: len(self.data_sets[i].motion)] /= np.sqrt(weight)
        return self.spreads[i] * scale

    def values(self, theta: np.ndarray) -> np.ndarray:
        """Coordinates -> values."""
        return np.array([u.to_value(c) for u, c in zip(self.unknowns, theta, strict=True)])

    def chain(self, values: np.ndarray) -> np.ndarray:
        """d(value)/d(coordinate)."""
        return np.array(
            [v if u.logarithmic else 1.0 for u, v in zip(self.unknowns, values, strict=True)]
        )


@dataclass(frozen=True)
class Block:
    """Data sets whose own unknowns are eliminated together.

    Attributes:
        data_sets: Their numbers.
        places: Of each, where its own vector lies in the block's.
        size: Length of the block's.
    """

    data_sets: tuple[int, ...]
    places: tuple[np.ndarray, ...]
    size: int


def _blocks(
    data_sets: Sequence[DataSet], own: Sequence[Unknown], unsettled: int
) -> tuple[Block, ...]:
    """Each data set alone or, where something belongs to a recording, with the others of that."""
    shared = np.array([u.each == 'recording' for u in own], bool)
    together: dict[str, list[int]] = {}
    for i, data_set in enumerate(data_sets):
        together.setdefault(data_set.recording if shared.any() else str(i), []).append(i)
    blocks = []
    for members in together.values():
        places, size = [], int(shared.sum())
        for i in members:
            first = len(data_sets[i].motion) + unsettled
            alone = first + int((~shared).sum())
            place = np.empty(first + len(own), int)
            place[np.concatenate([np.ones(first, bool), ~shared])] = size + np.arange(alone)
            place[np.concatenate([np.zeros(first, bool), shared])] = np.arange(shared.sum())
            places.append(place)
            size += alone
        blocks.append(Block(tuple(members), tuple(places), size))
    return tuple(blocks)


def compile_free(model: Model, names: Sequence[str]) -> tuple[str, ...] | None:
    """Parameters to compile sensitivities for: all declared free, and those asked for besides."""
    declared = model.declarations
    if all(declared[name].free for name in names):
        return None
    return tuple(n for n, p in declared.items() if p.free or n in names)


def _consistency(model: Model, names: tuple[str, ...]):
    symbols = {name: ca.SX.sym(name) for name in model.declarations}
    conditions = model.mechanism.consistency(symbols)
    if not conditions or not names:
        return None
    stacked = ca.vertcat(*conditions)
    moved = ca.vertcat(*(symbols[name] for name in names))
    function = ca.Function(
        'consistency', list(symbols.values()), [stacked, ca.jacobian(stacked, moved)]
    )
    fixed = model.values

    def evaluate(values: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        numbers = {**fixed, **dict(zip(names, values, strict=True))}
        stack, jacobian = function(*numbers.values())
        return np.asarray(stack).ravel(), np.asarray(ca.densify(jacobian))

    return evaluate


@dataclass(frozen=True)
class Border:
    """What keeps bodies possible, for a barrier of weight one: cost, gradient, curvature."""

    cost: float
    gradient: np.ndarray
    hessian: np.ndarray


@dataclass(frozen=True)
class Point:
    """Cost and normal equations at one point, the border of consistency with weight BARRIER.

    Own are curvature, coupling to what is shared, and gradient of each block of the problem.
    """

    cost: float
    shared_hessian: np.ndarray
    shared_gradient: np.ndarray
    own: list[tuple[np.ndarray, np.ndarray, np.ndarray]]  # D, E, g
    sse: np.ndarray
    count: np.ndarray
    data_cost: float
    border: Border

    def beside(self, before: float, barrier: float) -> 'Point':
        """The same with another weight of the border."""
        more = barrier - before
        return replace(
            self,
            cost=self.cost + more * self.border.cost,
            shared_gradient=self.shared_gradient + more * self.border.gradient,
            shared_hessian=self.shared_hessian + more * self.border.hessian,
        )


@dataclass(frozen=True)
class Followed:
    """One data set as the model goes along it.

    Attributes:
        rows: Within the horizon.
        judged: The simulation beside the record.
        start: Derivative of the initial state by the columns, shape (nx, columns).
        column: Of each compiled parameter.
    """

    rows: int
    judged: Judged
    start: np.ndarray
    column: np.ndarray

    @property
    def gone(self) -> bool:
        """Whether the simulation has run away."""
        return self.judged.rows < self.rows

    def normal(self, keep: bool = False) -> tuple[Normal, np.ndarray | None, np.ndarray | None]:
        """Normal equations and, if kept, outputs and Jacobian.

        Columns: what the data set has of its own, then the shared values (not coordinates).
        """
        return self.judged.normal(self.start, self.column, keep)


def follow(
    problem: Problem, i: int, values: np.ndarray, motion: np.ndarray, horizon: float
) -> Followed:
    """Data set i within the horizon."""
    data_set, compiled, u = problem.data_sets[i], problem.compiled[i], problem.inputs[i]
    p = problem.vectors[i].copy()
    p[problem.places[i]] = values
    p[problem.own_places[i]] = own_values(problem.own, motion)
    n = int(np.searchsorted(data_set.time, horizon, side='right'))
    start = problem.starts[i]
    x0, by_start, by_free = compiled.initial_sensitivity(motion[start], u[0], p)
    s0 = np.zeros((compiled.nx, len(motion) + len(values)))
    s0[:, start] = by_start
    for f, column in enumerate(problem.columns[i]):
        if column >= 0:
            s0[:, column] = by_free[:, f]
    judged = compiled.judge(
        data_set.time[:n], u[:n], x0, p, data_set.outputs[:n], 1 / data_set.sigma,
        refinement=problem.refinement,
    )  # fmt: skip
    return Followed(n, judged, s0, problem.columns[i])


@dataclass(frozen=True)
class Trial:
    """All data sets simulated at one point: its cost at once, its normal equations when asked for.

    A search turns half of its trials down by their cost, and the derivatives take most of the
    time. They are worked out once, whatever weights are asked for.

    Attributes:
        problem: What is minimised.
        theta: Coordinates of the unknowns, shape (k,).
        motions: What each data set has of its own.
        followed: The simulations.
        border: What keeps bodies possible there.
        horizon: How far they go, in s.
        known: Normal equations of data sets, by their numbers, as far as they were asked for.
    """

    problem: Problem
    theta: np.ndarray
    motions: list[np.ndarray]
    followed: list[Followed]
    border: Border
    horizon: float
    known: dict[int, Normal] = field(default_factory=dict)

    @functools.cached_property
    def sse(self) -> np.ndarray:
        """Squared error over noise variance of each data set and output."""
        return np.array([followed.judged.sse for followed in self.followed])

    @functools.cached_property
    def count(self) -> np.ndarray:
        """Samples behind it."""
        return np.array([followed.judged.count for followed in self.followed])

    def away(self, i: int, weight: float) -> np.ndarray:
        """How far what data set i has of its own is from its first guess, in spreads."""
        return (self.motions[i] - self.problem.guesses[i]) / self.problem.spread(i, weight)

    def disbelief(self) -> np.ndarray:
        """How far the unknowns are from what the model file believes, in its tolerances."""
        return np.array([
            (coordinate - u.to_coordinate(u.prior)) / u.tolerance
            for coordinate, u in zip(self.theta, self.problem.unknowns, strict=True)
        ])  # fmt: skip

    def cost_of(self, data_sets: Iterable[int], weight: float) -> float:
        """Of the data of some data sets, and of what each has of its own."""
        away = {i: self.away(i, weight) for i in data_sets}
        return float(sum(weight * self.sse[i].sum() + own @ own for i, own in away.items()))

    def cost_of_data(self, weight: float) -> float:
        """The same of all."""
        return self.cost_of(range(len(self.followed)), weight)

    def cost(self, weight: float, barrier: float = BARRIER) -> float:
        """Cost with so much weight of the data and of the border."""
        disbelief = self.disbelief()
        return float(
            self.cost_of_data(weight) + disbelief @ disbelief + barrier * self.border.cost
        )

    def equations(
        self, data_sets: Sequence[int], weight: float
    ) -> list[tuple[np.ndarray, np.ndarray]] | None:
        """Curvature and gradient of data sets, by what each has of its own, then the coordinates.

        None where the sensitivities run away, if the motion does not.
        """
        problem, chain = self.problem, self.problem.chain(self.problem.values(self.theta))
        unknown = [i for i in data_sets if i not in self.known]
        normals = side_by_side(lambda i: self.followed[i].normal()[0], unknown)
        self.known.update(zip(unknown, normals, strict=True))
        found = []
        for i in data_sets:
            normal, m2 = self.known[i], len(self.motions[i])
            if not np.abs(normal.hessian).max() < RUNAWAY:
                return None
            h, g = normal.hessian * weight, normal.gradient * weight
            h[m2:] *= chain[:, None]
            h[:, m2:] *= chain
            g[m2:] *= chain
            spread = problem.spread(i, weight)
            h[:m2, :m2] += np.diag(1 / spread**2)
            g[:m2] += self.away(i, weight) / spread
            found.append((h, g))
        return found

    def point(self, weight: float) -> Point | None:
        """The normal equations; None where the sensitivities run away, if the motion does not."""
        problem, k = self.problem, len(self.theta)
        found = self.equations(range(len(self.followed)), weight)
        if found is None:
            return None
        shared_h = np.sum([h[-k:, -k:] for h, _ in found], axis=0) if k else np.zeros((0, 0))
        shared_g = np.sum([g[-k:] for _, g in found], axis=0) if k else np.zeros(0)
        tolerances = np.array([u.tolerance for u in problem.unknowns])
        shared_g += self.disbelief() / tolerances
        shared_h += np.diag(1 / tolerances**2)
        blocks = [
            _together(block, [found[i] for i in block.data_sets]) for block in problem.blocks
        ]
        point = Point(
            self.cost(weight, 0.0), shared_h, shared_g, blocks, self.sse, self.count,
            self.cost_of_data(weight), self.border,
        )  # fmt: skip
        return point.beside(0.0, BARRIER)


def attempt(
    problem: Problem, theta: np.ndarray, motions: list[np.ndarray], horizon: float
) -> Trial | None:
    """All data sets simulated at one point; None where the simulation runs away."""
    k = len(theta)
    values = problem.values(theta)
    border = Border(0.0, np.zeros(k), np.zeros((k, k)))
    if problem.consistency is not None:
        c, jacobian = problem.consistency(values)
        if not (c > 0).all():
            return None
        jacobian = jacobian * problem.chain(values) / c[:, None]
        border = Border(-2 * np.log(c).sum(), -jacobian.sum(axis=0), jacobian.T @ jacobian)
    problem.evaluations += 1
    followed = list(side_by_side(
        lambda i: follow(problem, i, values, motions[i], horizon), range(len(problem.data_sets))
    ))  # fmt: skip
    if any(each.gone for each in followed):
        return None
    return Trial(problem, theta, motions, followed, border, horizon)


def settled(trial: Trial, before: Trial, weight: float) -> Trial:
    """A trial after the few blocks that its step led astray have settled by themselves.

    What a block has of its own moves with a step as if its error were quadratic. Where it is not,
    as where a joint with dry friction turns round, one window of many would spoil the step of all.
    """
    astray = []
    for block in trial.problem.blocks:
        enough = SPOILT * before.cost_of(block.data_sets, weight) + 1
        if trial.cost_of(block.data_sets, weight) > enough:
            astray.append((block, enough))
    if len(astray) > FEW * len(trial.problem.blocks):
        return trial
    for block, enough in astray:
        trial = _settled(trial, block, enough, weight)
    return trial


def _settled(trial: Trial, block: Block, enough: float, weight: float) -> Trial:
    """What a block has of its own, fitted at the trial's coordinates until it costs so little."""
    problem, damping, values = trial.problem, SETTLING_DAMPING, trial.problem.values(trial.theta)
    for _ in range(SETTLING_STEPS):
        found = trial.equations(block.data_sets, weight)
        if found is None:
            break
        curvature, _, gradient = _together(block, found)
        curvature += damping * np.diag(np.diag(curvature))
        move = -solve(curvature, gradient[:, None])[:, 0]
        motions, followed = list(trial.motions), list(trial.followed)
        for i, place in zip(block.data_sets, block.places, strict=True):
            motions[i] = trial.motions[i] + move[place]
            followed[i] = follow(problem, i, values, motions[i], trial.horizon)
        known = {i: n for i, n in trial.known.items() if i not in block.data_sets}
        other = replace(trial, motions=motions, followed=followed, known=known)
        gone = any(followed[i].gone for i in block.data_sets)
        cost = np.inf if gone else other.cost_of(block.data_sets, weight)
        if cost < trial.cost_of(block.data_sets, weight):
            trial, damping = other, damping / 10
            if cost < enough:
                break
        else:
            damping *= 100  # few steps are left
    return trial


def _together(
    block: Block, found: Sequence[tuple[np.ndarray, np.ndarray]]
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Curvature, coupling to the shared unknowns and gradient of a block's own unknowns."""
    k = len(found[0][1]) - len(block.places[0])
    d, e, g = np.zeros((block.size, block.size)), np.zeros((block.size, k)), np.zeros(block.size)
    for (h, gradient), place in zip(found, block.places, strict=True):
        m2 = len(place)
        d[np.ix_(place, place)] += h[:m2, :m2]
        e[place] += h[:m2, m2:]
        g[place] += gradient[:m2]
    return d, e, g


def moved(
    problem: Problem,
    motions: Sequence[np.ndarray],
    factors: Sequence[np.ndarray],
    step: np.ndarray,
) -> list[np.ndarray]:
    """What each data set has of its own after a step of the shared unknowns (`reduced`)."""
    found = list(motions)
    for block, solved in zip(problem.blocks, factors, strict=True):
        move = -(solved[:, -1] + solved[:, :-1] @ step)
        for i, place in zip(block.data_sets, block.places, strict=True):
            found[i] = motions[i] + move[place]
    return found


def own_values(own: Sequence[Unknown], motion: np.ndarray) -> np.ndarray:
    """Of what a data set has of its own, the values behind the initial motion, within range."""
    values = motion[len(motion) - len(own) :]
    return np.clip(values, [u.lower for u in own], [u.upper for u in own])


def reduced(point: Point, damping: float) -> tuple[np.ndarray, np.ndarray, list]:
    """Schur complement on the shared unknowns, with Marquardt damping on every diagonal."""
    h = point.shared_hessian + damping * np.diag(np.diag(point.shared_hessian))
    g = point.shared_gradient.copy()
    factors = []
    for d, e, own_g in point.own:
        damped = d + damping * np.diag(np.diag(d))
        solved = solve(damped, np.column_stack([e, own_g]))
        h -= e.T @ solved[:, :-1]
        g -= e.T @ solved[:, -1]
        factors.append(solved)
    return h, g, factors


def without_unnoticed(problem: Problem, point: Point, weight: float) -> Point:
    """A point from which no step moves what a data set has of its own and does not notice.

    A push that comes after the horizon is such. Steps are as long as a direction is flat, and that
    one, flat but for a tail of the push, would lead a long way off.
    """
    scales = np.array([u.scale for u in problem.own])
    blocks = []
    for block, (curvature, coupling, gradient) in zip(problem.blocks, point.own, strict=True):
        at = np.array([place[len(place) - len(scales) :] for place in block.places], int)
        unnoticed = np.unique(at[np.diag(curvature)[at] * scales**2 < weight])
        steep = np.diag(curvature)[unnoticed]
        curvature, coupling, gradient = curvature.copy(), coupling.copy(), gradient.copy()
        curvature[unnoticed] = curvature[:, unnoticed] = 0.0
        curvature[unnoticed, unnoticed] = steep
        coupling[unnoticed], gradient[unnoticed] = 0.0, 0.0
        blocks.append((curvature, coupling, gradient))
    return replace(point, own=blocks)


def solve(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """The x of a x = b for a curvature a; directions lost beside far steeper ones stay."""
    # Where sensitivities run away a small curvature is lost in rounding, and may be below nothing.
    diagonal = np.diag(a)
    scale = np.sqrt(np.maximum(diagonal, max(LOST * diagonal.max(initial=0.0), 1e-300)))
    scaled, b = a / np.outer(scale, scale), b / scale[:, None]
    try:
        x = np.linalg.solve(scaled, b)
    except np.linalg.LinAlgError:
        x = np.linalg.lstsq(scaled, b, rcond=1e-12)[0]
    return x / scale[:, None]
