"""Fit of the law of contact to landings, in simulation error: theory.md, (LANDFIT).

    J = sum over landings  |y_sim - y_measured|^2_W + |own - centre|^2_belief

over the law, common to all, and what each landing has of its own (landings.py). Gauss-Newton with
differences, as a landing is a sequence of events; each landing's own unknowns are eliminated by a
Schur complement.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from cg_dynamics.effects import LIBRARY
from cg_dynamics.effects.effect import ContactLaw
from cg_dynamics.errors import DynamicsError
from cg_dynamics.model import Model
from cg_sysid.deadline import check_time
from cg_sysid.errors import Failure
from cg_sysid.landings.landings import NUDGES, OWN, Passage, simulate_passage

# Effect -> what it changes of the law.
FREE = {'impact_restitution': 'restitution', 'foot_slip': 'friction'}
SMALLEST = 1e-3  # of a parameter that an effect has; below it is none
NUDGE = 5e-4
PASSED = 2.0  # change of a rate's residual that a nudge makes where an event passes a sample
KEPT = 0.5  # share of the promised gain
# A sample of a rate is from before an event or from after it. Off by a hundred standard deviations
# it says no more than off by five: or else every sample would fence the instant of an event in.
SATURATED = 5.0
ITERATIONS = 12
FIRST_ITERATIONS = 2  # of the landings' own unknowns at a start
LOOKED_AT = 4  # landings by which starts are compared
SHIFTS = (1.5e-3, -1.5e-3, 3e-3, -3e-3)  # rad, of the ground's slope
POOR = (1.15, 30.0)  # chi2/N between which another instant of the touchdown may be the better one
FARTHEST = np.array([0.3, 0.3, 10.0, 10.0, 0.1])  # of a landing's own from its belief
LONGEST = 0.7  # step of a coordinate
DRIFT = 1e-3  # share of the cost above the noise that is a small change
SMALL_GAIN = 0.1  # squared standard deviations: nobody would call one fit better than another


@dataclass(frozen=True)
class ContactTask:
    """One law to fit.

    Attributes:
        model: The model with all causes of the phases.
        law: The law that the model file states.
        effects: Effects whose parameter is free.
        train: Landings to fit.
        held: Landings to judge on, of which only their own is fitted.
        sigma: Noise floor of each output, shape (ny,).
        starts: Effect -> values from which to set out besides the library's own.
    """

    model: Model
    law: ContactLaw
    effects: tuple[str, ...]
    train: tuple[Passage, ...]
    held: tuple[Passage, ...]
    sigma: np.ndarray
    starts: Mapping[str, tuple[float, ...]] = field(default_factory=dict)


@dataclass(frozen=True)
class ContactFit:
    """A law fitted to landings.

    Attributes:
        effects: Effects whose parameter was free; none for the law as stated.
        law: The law.
        values: Effect -> value and standard deviation of its parameter.
        residuals: Simulated less measured over noise, of each landing of the training set, then
            of each held out, shape (n, ny), NaN where there is no sample.
        own: What each of them has of its own, shape (5,).
        belief: Squared distance of that from its belief, all landings together.
        converged: False if it stopped at the limit of iterations.
    """

    effects: tuple[str, ...]
    law: ContactLaw
    values: dict[str, tuple[float, float]]
    residuals: tuple[np.ndarray, ...]
    own: tuple[np.ndarray, ...]
    belief: float
    converged: bool

    @property
    def chi2(self) -> float:
        """Squared error over noise variance, of all landings."""
        return float(sum(np.nansum(r**2) for r in self.residuals))

    @property
    def samples(self) -> int:
        """Samples behind it."""
        return int(sum(np.isfinite(r).sum() for r in self.residuals))


@dataclass
class _State:
    """A landing during a fit: its own, and residuals there."""

    own: np.ndarray
    residual: np.ndarray
    jacobian: np.ndarray | None = None  # by its own unknowns, shape (n, 5)

    @property
    def cost(self) -> float:
        return float(self.residual @ self.residual)


def fit_contact(task: ContactTask) -> ContactFit | Failure:
    """Fit one law on the training landings and score it on those held out.

    Returns:
        The fit, or a sentence saying why there is none.
    """
    try:
        return _fit(_Fitter(task), task)
    except np.linalg.LinAlgError as error:
        return Failure(f'{" and ".join(task.effects) or "the law"}: {error}')


def _fit(fitter: '_Fitter', task: ContactTask) -> ContactFit | Failure:
    start = fitter.start()
    if start is None:
        return Failure(
            f'no landing can be simulated with {" and ".join(task.effects) or "the law"}'
        )
    theta, states, converged = fitter.minimise(start)
    spread = fitter.uncertainty(theta, states)
    values = {
        name: (value, float(s) * (value if FREE[name] == 'friction' else 1.0))
        for name, value, s in zip(
            task.effects, fitter.parameters(theta), spread, strict=True
        )
    }  # fmt: skip
    held = [fitter.settled(theta, passage) for passage in task.held]
    both = [*states, *held]
    passages = (*task.train, *task.held)
    found = [fitter.unpacked(p, s) for p, s in zip(passages, both, strict=True)]
    belief = sum(0.0 if s is None else float(s.residual[-OWN:] @ s.residual[-OWN:]) for s in both)
    return ContactFit(
        task.effects, fitter.law(theta), values, tuple(found),
        tuple(p.centre if s is None else s.own for p, s in zip(passages, both, strict=True)),
        belief, converged,
    )  # fmt: skip


class _Fitter:
    def __init__(self, task: ContactTask):
        self.task = task
        units = task.model.mechanism.output_units
        self.rates = np.array([unit == 'rad/s' for unit in units])

    def parameters(self, theta: np.ndarray) -> list[float]:
        """Coordinates -> values: friction by its logarithm, restitution as it is."""
        found = []
        for name, t in zip(self.task.effects, theta, strict=True):
            p = LIBRARY[name].parameters[0]
            value = math.exp(t) if FREE[name] == 'friction' else float(t)
            found.append(min(max(value, max(p.lower, SMALLEST)), p.upper))
        return found

    def law(self, theta: np.ndarray) -> ContactLaw:
        moved = zip(self.task.effects, self.parameters(theta), strict=True)
        return replace(self.task.law, **{FREE[name]: value for name, value in moved})

    def coordinates(self, values: Sequence[float]) -> np.ndarray:
        return np.array([
            math.log(v) if FREE[name] == 'friction' else v
            for name, v in zip(self.task.effects, values, strict=True)
        ])  # fmt: skip

    def residual(self, theta: np.ndarray, passage: Passage, own: np.ndarray) -> np.ndarray | None:
        """Residuals over noise, those of the belief last; None where it runs away."""
        if not (np.abs(own - passage.centre) < FARTHEST).all():
            return None
        try:
            y = simulate_passage(self.task.model, passage, self.law(theta), own)
        except DynamicsError:
            return None
        r = np.nan_to_num((y - passage.outputs) / self.task.sigma)
        r[:, self.rates] = SATURATED * np.tanh(r[:, self.rates] / SATURATED)
        return np.concatenate([r.ravel(), passage.root @ (own - passage.centre)])

    def unpacked(self, passage: Passage, state: _State | None) -> np.ndarray:
        if state is None:
            return np.full(passage.outputs.shape, np.nan)
        r = state.residual[:-OWN].reshape(passage.outputs.shape)
        return np.where(np.isfinite(passage.outputs), r, np.nan)

    def settle(
        self,
        theta: np.ndarray,
        passage: Passage,
        own: np.ndarray | None = None,
        iterations: int = 8,
    ) -> _State | None:
        """A landing at a given law, its own unknowns fitted."""
        own = passage.centre if own is None else own
        r = self.residual(theta, passage, own)
        if r is None:
            return None
        state, damping, J = _State(own, r), 1e-6, None
        for _ in range(iterations):
            fresh = J is None
            J = self.own_jacobian(theta, passage, state) if J is None else J
            H, g = J.T @ J, J.T @ state.residual
            step = -np.linalg.solve(H + damping * np.diag(np.diag(H)), g)
            r = self.residual(theta, passage, state.own + step)
            if r is None or r @ r > state.cost:
                if fresh:
                    damping = max(10 * damping, 1e-3)
                else:
                    J, state.jacobian = None, None
                continue
            gain, promised = state.cost - r @ r, -(g @ step)
            state, damping = _State(state.own + step, r, J), damping / 10
            if gain < _small(state.cost, passage):
                break
            # Differences are dear: while they keep their promise they are used again.
            if gain < KEPT * promised:
                J, state.jacobian = None, None
        return state

    def own_jacobian(self, theta: np.ndarray, passage: Passage, state: _State) -> np.ndarray:
        if state.jacobian is None:
            columns = []
            for nudge in np.diag(NUDGES):
                r = self.residual(theta, passage, state.own + nudge)
                columns.append(self.difference(state.residual, r) / nudge.max())
            state.jacobian = np.column_stack(columns)
        return state.jacobian

    def difference(self, before: np.ndarray, after: np.ndarray | None) -> np.ndarray:
        """Small changes of residuals; where an event has passed over a sample there is none."""
        if after is None:
            return np.zeros(len(before))
        moved = after - before
        rates = moved[:-OWN].reshape(-1, len(self.rates))[:, self.rates]
        rates[np.abs(rates) > PASSED] = 0.0
        moved[:-OWN].reshape(-1, len(self.rates))[:, self.rates] = rates
        return moved

    def settled(self, theta: np.ndarray, passage: Passage) -> _State | None:
        """The same from several instants of the touchdown where one leaves an error."""
        best = self.settle(theta, passage)
        rows = np.isfinite(passage.outputs).sum()
        for shift in SHIFTS:
            if best is None or not POOR[0] < best.cost / rows < POOR[1]:
                return best
            own = best.own + shift * np.eye(OWN)[-1]
            again = self.settle(theta, passage, own)
            if again is not None and again.cost < best.cost:
                best = again
        return best

    def start(self) -> np.ndarray | None:
        """The best of the effects' starts, by a few landings."""
        task = self.task
        grids = [
            (*task.starts.get(name, ()), *LIBRARY[name].parameters[0].starts)
            for name in task.effects
        ]
        points = [self.coordinates(values) for values in _grid(grids)]
        if len(points) == 1:
            return points[0]
        few = task.train[:: max(1, len(task.train) // LOOKED_AT)][:LOOKED_AT]
        costs = []
        for theta in points:
            states = [self.settle(theta, p, iterations=FIRST_ITERATIONS) for p in few]
            costs.append(sum(math.inf if s is None else s.cost for s in states))
        best = int(np.argmin(costs))
        return points[best] if math.isfinite(costs[best]) else None

    def minimise(self, theta: np.ndarray) -> tuple[np.ndarray, list[_State | None], bool]:
        """Law and own unknowns of the training landings together."""
        train = self.task.train
        states = [self.settled(theta, p) for p in train]
        if not len(theta):
            return theta, states, True
        damping = 1e-4
        for _ in range(ITERATIONS):
            check_time()
            H, g, solved = self.reduced(theta, states, damping)
            damped = H + damping * np.diag(np.diag(H))
            step = np.clip(-np.linalg.lstsq(damped, g, rcond=1e-12)[0], -LONGEST, LONGEST)
            candidate = self.coordinates(self.parameters(theta + step))
            step = candidate - theta
            moved: list[_State | None] = []
            for passage, state, part in zip(train, states, solved, strict=True):
                if state is None:
                    moved.append(None)
                    continue
                own = state.own - part[:, -1] - part[:, :-1] @ step
                r = self.residual(candidate, passage, own)
                # A landing that fares worse by this step may only need another motion of its own.
                again = None if r is None else _State(own, r, state.jacobian)
                if again is None or again.cost > state.cost:
                    settled = self.settle(candidate, passage, state.own, FIRST_ITERATIONS)
                    if again is None or (settled is not None and settled.cost < again.cost):
                        again = settled
                moved.append(again)
            before, after = _total(states), _total(moved)
            lost = sum(m is None and s is not None for s, m in zip(states, moved, strict=True))
            if lost or after > before:
                damping = max(10 * damping, 1e-3)
                states = [s and replace(s, jacobian=None) for s in states]
                if damping > 1e3:
                    return theta, states, True
                continue
            theta, states, damping = candidate, moved, damping / 10
            if before - after < _small(after, *train):
                return theta, states, True
        return theta, states, False

    def reduced(
        self, theta: np.ndarray, states: Sequence[_State | None], damping: float
    ) -> tuple[np.ndarray, np.ndarray, list[np.ndarray]]:
        """Schur complement on the law, and what eliminates the own unknowns."""
        k = len(theta)
        H, g, solved = np.zeros((k, k)), np.zeros(k), []
        for passage, state in zip(self.task.train, states, strict=True):
            if state is None:
                solved.append(np.zeros((OWN, k + 1)))
                continue
            h, e, d, shared_g, own_g = self.blocks(theta, passage, state)
            part = np.linalg.solve(d + damping * np.diag(np.diag(d)), np.column_stack([e, own_g]))
            H += h - e.T @ part[:, :-1]
            g += shared_g - e.T @ part[:, -1]
            solved.append(part)
        return H, g, solved

    def blocks(self, theta: np.ndarray, passage: Passage, state: _State):
        columns = []
        for nudge in np.eye(len(theta)) * NUDGE:
            r = self.residual(theta + nudge, passage, state.own)
            columns.append(self.difference(state.residual, r) / NUDGE)
        shared, own = np.column_stack(columns), self.own_jacobian(theta, passage, state)
        r = state.residual
        return shared.T @ shared, own.T @ shared, own.T @ own, shared.T @ r, own.T @ r

    def uncertainty(self, theta: np.ndarray, states: Sequence[_State | None]) -> np.ndarray:
        """Standard deviation of each coordinate: theory.md, (COV), a block for each landing."""
        if not len(theta):
            return np.zeros(0)
        H = np.zeros((len(theta), len(theta)))
        scores, cost, rows = [], 0.0, 0
        for passage, state in zip(self.task.train, states, strict=True):
            if state is None:
                continue
            h, e, d, shared_g, own_g = self.blocks(theta, passage, state)
            part = np.linalg.solve(d, np.column_stack([e, own_g]))
            H += h - e.T @ part[:, :-1]
            scores.append(shared_g - e.T @ part[:, -1])
            cost += state.cost
            rows += int(np.isfinite(passage.outputs).sum())
        inverse = np.linalg.pinv(H)
        excess = max(1.0, cost / max(rows, 1))
        sandwich = inverse @ (np.transpose(scores) @ np.array(scores)) @ inverse
        return np.sqrt(np.maximum(np.diag(inverse) * excess, np.diag(sandwich)))


def _small(cost: float, *passages: Passage) -> float:
    """What is no gain any more, the less so the further the noise is."""
    rows = sum(int(np.isfinite(passage.outputs).sum()) for passage in passages)
    return SMALL_GAIN + DRIFT * max(cost - rows, 0.0)


def _total(states: Sequence[_State | None]) -> float:
    return sum(s.cost for s in states if s is not None)


def _grid(grids: Sequence[Sequence[float]]) -> list[list[float]]:
    points: list[list[float]] = [[]]
    for grid in grids:
        points = [[*point, value] for point in points for value in grid]
    return points
