"""Which effects could the torques of a robot of many joints know of? A score test before any fit.

About the torque error r of the base (torque_error.py), with J its derivative by the numbers of the
base and D that by the numbers of one candidate at its start,

    gain = (|P r|^2 - min_d |P (r + D d)|^2) / 2,    P: without what J and its belief explain

in standard deviations of what the base leaves; rows far beyond them, where friction turns within a
window, count less. D costs no fit and no compilation:

    a torque on a joint, a body    derivative of its generalised force along the measured motion
    a sensor                       of the motion that it would make of the measured one
    a delay                        of the torque by time, or of the motion

A push is sought where it would be: in sums of some consecutive rows, at each place of the records.
Of the links that explain the largest as well as any, the one nearest to the base has it.

Those that gain most are then fitted by torque error, at once with the numbers of the base: what
is far from its start is far from linear. What has states of its own, as a flexible drive, has no
D; it is looked at on the joint of which the torques are worst explained, and on the one whose
motion is simulated worst: play in a light wrist shows in no torque. A robot of six joints has 150
candidates, and a fit of one takes seconds.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace

import casadi as ca
import numpy as np

from cg_dynamics.assemble import Equations, assemble, overrides, parameter_vector
from cg_dynamics.effects import LIBRARY
from cg_dynamics.effects.effect import CLOCKS
from cg_dynamics.mechanisms.urdf import Urdf
from cg_dynamics.model import Model
from cg_sysid.identification import torque_error
from cg_sysid.identification.along_motion import Samples
from cg_sysid.identification.data_set import DataSet
from cg_sysid.identification.measured_motion import Motion
from cg_sysid.identification.student_t import row_scale, spread_of
from cg_sysid.identification.torque_error import Problem, TorqueFit
from cg_sysid.identification.unknowns import Unknown, unknowns_of
from cg_sysid.identification.window_torque import WindowTorque
from cg_sysid.parallel import CarryOut, one_by_one
from cg_sysid.search.nuisance import Bounds
from cg_sysid.search.starts import starts_beside, starts_of
from cg_sysid.search.task import EffectAt

SEEN = 10.0  # nats that a candidate has to gain
FITTED = 16  # candidates that are fitted by torque, the best first
STARTS = 4  # of each, from which they are fitted, the best first
KEPT = 8  # of these, that are looked at, at least
LOOKS = 32  # and so many over the number of joints: looks at robots of few joints are cheap
NEAR = 0.5  # share of the best one's gain from which one is kept beyond these
IDLE = 0.1  # share below which one can wait for the next round
LATE = 1e-2  # share below which a delay can wait too
AT_NOISE = 1.3  # times what the noise of the encoders makes: up to here torques show nothing else
HINT = 1.0  # nats, from which a candidate then gets a look
WORST = 2  # joints on which effects with states are looked at
LOSS = 'viscous_friction'  # of which a simulation of seconds tells more than torques do
TILT = 'ground_slope'  # the same of joints that nothing drives
PULSES = 1, 2, 4  # rows that a push may last: 0.04 to 0.16 s, twice that of coarse encoders
BLOCK = 12  # rows, 0.5 s, or twice that
QUIET = 0.9  # share of the blocks at least in which nobody pushes
SLOW = 0.1  # of the usual rate of a joint
BEGINS = 3  # rows, as long as the window of a local polynomial
STANDS_OUT = 4.0  # ratio of what a push gains to what any of these blocks does


@dataclass(frozen=True)
class Scores:
    """What the torques say of candidates.

    Attributes:
        gains: (effect, place) -> nats that it could gain by the score; of those that have a D.
        fitted: Of the best of these, and of those without a D or states: nats by a torque fit. Not
            of sensors and delays.
        worst: Joints, those of which torques are explained or motions simulated worst first.
        pushed: What pushes once, where it may have: (effect, place).
        extended: The base with each of `fitted` where it has a fit, at its start, and that fit.
        at_noise: Whether the torque errors of the base are no more than encoders make of theirs.
        passive: Whether a joint moves that no drive turns directly.
    """

    gains: dict[EffectAt, float]
    fitted: dict[EffectAt, float]
    worst: tuple[str, ...]
    pushed: tuple[EffectAt, ...] = ()
    extended: dict[EffectAt, tuple[Model, TorqueFit]] = field(default_factory=dict)
    at_noise: bool = False
    passive: bool = False

    def worth(self, candidates: Sequence[EffectAt]) -> list[EffectAt]:
        """Those to be looked at."""
        # A sensor is judged beside sensors: laws of torque may gain by what they make of masses.
        sensors = {c: gain for c, gain in self.gains.items() if _sensed(c[0]) and not _late(c[0])}
        best = max(sensors.values(), default=0.0)
        sensed = {c for c, gain in sensors.items() if gain > max(SEEN, NEAR * best)}
        # Where numbers make up for each other a torque fit may stop in the valley, or fail.
        promised = {c: max(gain, self.gains.get(c, 0.0)) for c, gain in self.fitted.items()}
        ordered = sorted(promised, key=lambda c: -promised[c])
        # Torques and masses that shrink together leave less: what gains only so rules nobody out.
        best = max((promised[c] for c in ordered if self.gains.get(c, 0.0) > SEEN), default=0.0)
        kept = max(KEPT, LOOKS // len(self.worst))
        seen = sensed | {
            c
            for place, c in enumerate(ordered)
            if promised[c] > max(SEEN, (IDLE if place < kept else NEAR) * best)
        }
        if self.at_noise:  # what gains most there is not far ahead of the others
            seen |= {c for c, gain in self.gains.items() if gain > HINT}
        unseen = {
            (name, at)
            for name, at in candidates
            if (name, at) not in self.gains
            and (name, at) not in self.fitted
            and _on_worst(name, at, self.worst)
        }
        # What a joint loses in each swing adds up in a simulation, and drowns in noisy rates here.
        unseen |= {c for c in candidates if c[0] == LOSS and _on_worst(*c, self.worst)}
        # Where a joint comes to rest that nothing drives shows at once, in no torque.
        unseen |= {c for c in candidates if c[0] == TILT and self.passive}
        # Smoothed torques know little of delays: they wait beside what gains far more only.
        unseen |= {
            c for c in candidates if _late(c[0]) and not self.gains.get(c, np.inf) < LATE * best
        }
        return [c for c in candidates if c in seen or c in unseen or c in self.pushed]

    def best(self) -> list[tuple[EffectAt, float]]:
        """Candidates that torque fits speak for, and their nats, the best first."""
        ordered = sorted(self.fitted.items(), key=lambda item: -item[1])
        return [(candidate, nats) for candidate, nats in ordered if nats > SEEN]


def most_promising(gains: Mapping[EffectAt, float]) -> list[EffectAt]:
    """Those that gain most by the score, the best first."""
    return sorted(gains, key=lambda c: -gains[c])[:FITTED]


def scores(
    model: Model,
    train: Sequence[DataSet],
    candidates: Sequence[EffectAt],
    bounds: Bounds,
    carry_out: CarryOut = one_by_one,
    held: Sequence[DataSet] = (),
    missed: Mapping[str, float] | None = None,
    numbers: Mapping[str, float] | None = None,
    followed: Callable[[Mapping[EffectAt, float]], Sequence[EffectAt]] = most_promising,
    title: str = 'what torques say',
) -> Scores | None:
    """What the torques say of candidates on top of a model.

    Args:
        model: The base.
        train: Prepared records that it is fitted to.
        candidates: (effect, place).
        bounds: Of small faults.
        carry_out: Who fits.
        held: Other records, in which somebody may have pushed as well.
        missed: What the base leaves of each output in simulation, chi2/N, where that is known.
        numbers: Where the base stands (full name -> value), if its torque fit is not to set out
            from the file's numbers.
        followed: Of gains by the score, of candidates that torques can tell: those that are
            fitted.
        title: What to call the fits.

    Returns:
        Their scores; None where torques say nothing.
    """
    if not torque_error.can(model):
        return None
    base = _Base.of(model, train, bounds, numbers)
    if base is None:
        return None
    starts = {c: _starts(model, c, train) for c in candidates}
    tests = {c: s for c in candidates if (s := base.score_tests(*c, starts[c])) is not None}
    gains = {c: max(0.0, *of_starts) for c, of_starts in tests.items()}
    joints = model.mechanism.coordinates
    noise = _noise(base.problems, base.by_motion)
    order = np.argsort(-base.fitted.rms / np.maximum(noise, 1e-12))
    worst = _worst([joints[k] for k in order], missed or {})
    follow = followed({c: gain for c, gain in gains.items() if not _sensed(c[0])})
    promising = {c: [starts[c][k] for k in np.argsort(tests[c])[::-1][:STARTS]] for c in follow}
    for name, at in candidates:
        effect = LIBRARY[name](model.mechanism, at)
        if (name, at) in gains or effect.states or _sensed(name):
            continue
        if _on_worst(name, at, worst):
            promising[name, at] = starts[name, at][:STARTS]
    fits = carry_out(
        _best_fit,
        [(base.plain, c, own, train, bounds, base.fitted) for c, own in promising.items()],
        title,
    )
    extended = {c: found for c, found in zip(promising, fits, strict=True) if found is not None}
    by_fit = {
        c: (base.fitted.deviance - extended[c][1].deviance) / 2 if c in extended else 0.0
        for c in promising
    }
    pushers = [c for c in candidates if _happens(c[0])]
    pushed = base.pushed(pushers, [*train, *held]) if pushers else ()
    at_noise = bool((np.nan_to_num(base.fitted.scale) < AT_NOISE * noise).all())
    passive = not set(model.mechanism.all_joints) <= set(model.mechanism.joints)
    return Scores(gains, by_fit, worst, pushed, extended, at_noise, passive)


@dataclass(frozen=True)
class _Base:
    """What the torques leave of a base, for score tests on top of it.

    Attributes:
        plain: The model without states.
        model: The same with the numbers that the torques say.
        unknowns: Those of its numbers that torques see.
        theta: Their coordinates, shape (k,).
        fitted: The torque fit.
        problems: Motions, with the torques that the model predicts.
        by_motion: Derivatives of the torques by the motion, of each of these.
        scale: By which to divide each residual, shape (rows, n).
        taken: Orthonormal columns: what its numbers and beliefs can take.
        left: Weighted residual and beliefs, less that.
        weightless: Its joints without bodies, and without its effects.
    """

    plain: Model
    model: Model
    unknowns: tuple[Unknown, ...]
    theta: np.ndarray
    fitted: TorqueFit
    problems: list[Problem]
    by_motion: list[np.ndarray]
    scale: np.ndarray
    taken: np.ndarray
    left: np.ndarray
    weightless: Model

    @classmethod
    def of(
        cls,
        model: Model,
        train: Sequence[DataSet],
        bounds: Bounds,
        at: Mapping[str, float] | None,
    ) -> '_Base | None':
        """A model fitted by torques; None where they say nothing of it."""
        plain = torque_error.without_states(model)
        declared = plain.declarations
        unknowns = tuple(u for u in unknowns_of(model, None, bounds) if u.name in declared)
        fitted = torque_error.fit_by_torque(plain, train, None, bounds, at)
        problems = torque_error.problems_of(plain, train, unknowns)
        if fitted is None or not problems:
            return None
        theta = np.array([u.to_coordinate(fitted.values[u.name]) for u in unknowns])
        prior = np.array([u.to_coordinate(u.prior) for u in unknowns])
        tolerance = np.array([u.tolerance for u in unknowns])
        residual = torque_error.residuals(problems, unknowns, theta)
        jacobian = torque_error.derivatives(problems, unknowns, theta)
        # Few rows are far off, where friction turns within a window: they count less, as in fits.
        scale = np.nan_to_num(row_scale(residual, fitted.scale), nan=1.0)
        known = (jacobian / scale[:, :, None]).reshape(residual.size, -1)
        # The belief is as good as measurements of the numbers themselves.
        believed = np.isfinite(tolerance)
        belief = np.diag(1 / tolerance)[believed]
        taken, _ = np.linalg.qr(np.vstack([known, belief]))
        off = ((theta - prior) / tolerance)[believed]
        left = np.concatenate([np.nan_to_num(residual / scale).ravel(), off])
        values = plain.with_values(fitted.values)
        problems = _as_predicted(plain, problems, residual)
        by_motion = [_by_motion(problem, values) for problem in problems]
        return cls(plain, values, unknowns, theta, fitted, problems, by_motion, scale, taken,
                   left - taken @ (taken.T @ left), _without_bodies(values))  # fmt: skip

    def score_tests(
        self, name: str, at: str | None, starts: Sequence[dict[str, float]]
    ) -> list[float] | None:
        """Nats that a candidate could gain from each of its starts; None of one without a D."""
        columns = _columns(
            self.model, self.weightless, name, at, starts, self.problems, self.by_motion
        )
        return None if columns is None else [self._score(start) for start in columns]

    def _score(self, columns: np.ndarray) -> float:
        d = np.zeros((len(self.left), columns.shape[2]))
        d[: self.scale.size] = (columns / self.scale[:, :, None]).reshape(self.scale.size, -1)
        d -= self.taken @ (self.taken.T @ d)
        solution, *_ = np.linalg.lstsq(d, -self.left, rcond=1e-9)
        rest = self.left + d @ solution
        return float(self.left @ self.left - rest @ rest) / 2

    def pushed(
        self, pushers: Sequence[EffectAt], data_sets: Sequence[DataSet]
    ) -> tuple[EffectAt, ...]:
        """Of those that push once, who may have in one of these records."""
        problems = torque_error.problems_of(self.plain, data_sets, self.unknowns)
        residual = np.nan_to_num(torque_error.residuals(problems, self.unknowns, self.theta))
        return _pushed(self.model, pushers, problems, residual)


def _worst(by_torque: Sequence[str], missed: Mapping[str, float]) -> tuple[str, ...]:
    """Joints, the worst first by torques and by what a simulation leaves of their encoders."""
    moved = sorted(by_torque, key=lambda joint: -missed.get(f'{joint}_position', 0.0))
    return tuple(dict.fromkeys([by_torque[0], moved[0], *by_torque]))


def _happens(name: str) -> bool:
    """Whether an effect is one of single records, as a push."""
    return any(p.each == 'record' for p in LIBRARY[name].parameters)


def _on_worst(name: str, at: str | None, worst: Sequence[str]) -> bool:
    """Whether something that has no D acts where torques are worst explained."""
    return not _happens(name) and (at is None or _joint(at) in worst[:WORST])


def _turning(rates: np.ndarray) -> np.ndarray:
    """Where a joint turns around, or nearly rests: there torques are off by friction's shape."""
    size = np.maximum(np.sqrt(np.mean(rates**2, axis=0)), 1e-300)
    slow = np.abs(rates) < SLOW * size
    slow[1:] |= rates[1:] * rates[:-1] < 0
    slow[:-1] |= slow[1:]
    slow[1:] |= slow[:-1]
    return slow


def _beginning(first: np.ndarray) -> np.ndarray:
    """Rows at which the torques of a record set in: no polynomial follows the jump."""
    begun = first.copy()
    for _ in range(BEGINS - 1):
        begun[1:] |= begun[:-1]
    return begun


def _beyond_friction(model: Model, error: np.ndarray, rates: np.ndarray) -> np.ndarray:
    """What is left of errors of torques where a joint turns around, less what friction may do.

    Dry friction changes its sign there, so twice of it; where the model has none, all.

    Args:
        model: With its numbers fitted.
        error: N m (N), (rows, n).
        rates: (rows, n).
    """
    joints = model.mechanism.coordinates
    allowed = np.full(len(joints), np.inf)
    for k, joint in enumerate(joints):
        level = model.dry_friction(joint)
        if level:
            allowed[k] = 2 * level
    beyond = np.sign(error) * np.maximum(np.abs(error) - allowed, 0.0)
    return np.where(_turning(rates), beyond, error)


def _pushed(
    model: Model,
    candidates: Sequence[EffectAt],
    problems: Sequence[Problem],
    error: np.ndarray,
) -> tuple[EffectAt, ...]:
    """The pushes that are worth a fit, if any.

    Most blocks of rows are without one. What stands out of them as much as it does elsewhere is an
    error of the model. That a push stands out is told by errors that are none of friction; which
    link has it, by all: of those that gain as much, the one nearest to the base.

    Args:
        model: The base, with its numbers fitted.
        candidates: Pushes, (effect, place).
        problems: What was measured, of as many rows together.
        error: Of the torques, N m (N), 0 of joints that a set-up locks, (rows, n).
    """
    rates = np.vstack([p.of_all(p.motion.rate, 0.0) for p in problems])
    first = np.concatenate([p.motion.first for p in problems])
    error = np.where(_beginning(first)[:, None], 0.0, error)
    settled = _beyond_friction(model, error, rates)
    spread = spread_of(error)  # a push is far off, and counts in full
    about = {c: _about(model, c) for c in candidates}
    clear, every = (
        {c: _gains((rows / spread)[:, joints]) for c, joints in about.items()}
        for rows in (settled, error)
    )
    found = []
    for gains in clear.values():
        block = int(np.argmax(gains))
        if gains[block] > max(SEEN, STANDS_OUT * np.quantile(gains, QUIET)):
            found.append((float(gains[block]), block))
    if not found:
        return ()
    _, block = max(found)
    nearest = []
    for gained in (clear, every):
        there = {c: float(gains[block]) for c, gains in gained.items()}
        near = [c for c in candidates if there[c] > max(there.values()) - SEEN]
        nearest.append(min(near, key=lambda c: len(about[c])))
    return tuple(dict.fromkeys(nearest))


def _about(model: Model, candidate: EffectAt) -> list[int]:
    """Of the coordinates, those that a push acts about."""
    effect = LIBRARY[candidate[0]](model.mechanism, candidate[1])
    acting = {p.name for p in effect.parameters if p.neutral is not None}
    joints = model.mechanism.coordinates
    return [k for k, joint in enumerate(joints) if f'impulse_{joint}' in acting]


def _gains(error: np.ndarray) -> np.ndarray:
    """Nats that a push gains by errors of torques, the largest of each block of the rows."""
    total = np.cumsum(np.vstack([np.zeros(error.shape[1]), error]), axis=0)
    gains = np.zeros(BLOCK * -(-len(error) // BLOCK))
    for n in PULSES:
        own = ((total[n:] - total[:-n]) ** 2).sum(axis=1) / n / 2
        gains[: len(own)] = np.maximum(gains[: len(own)], own)
    return gains.reshape(-1, BLOCK).max(axis=1)


def _sensed(name: str) -> bool:
    """Whether an effect is one of sensors or of time, of which a torque fit does not know."""
    return LIBRARY[name].place in ('sensor', 'timing')


def _late(name: str) -> bool:
    """Whether an effect is one of time, as a delay."""
    return LIBRARY[name].place == 'timing'


def _starts(model: Model, candidate: EffectAt, train: Sequence[DataSet]) -> list[dict[str, float]]:
    """Where a candidate sets out: from as many values as it declares."""
    effect = LIBRARY[candidate[0]](model.mechanism, candidate[1])
    found = starts_beside(effect, model.mechanism, train)
    return found[:: -(-len(found) // len(starts_of(effect)))]


def _best_fit(
    model: Model,
    candidate: EffectAt,
    promising: Sequence[dict[str, float]],
    train: Sequence[DataSet],
    bounds: Bounds,
    base: TorqueFit,
) -> tuple[Model, TorqueFit] | None:
    """The base with a candidate, fitted together: at its best start, and what the torques say.

    Args:
        model: The base, without states.
        candidate: (effect, place).
        promising: Those of its starts that are tried.
        train: Prepared records.
        bounds: Of small faults.
        base: Its fit.
    """
    name, at = candidate
    label = LIBRARY[name](model.mechanism, at).label
    small = any(effect.label == label for effect in model.effects)
    without = model.without_effect(label) if small else model
    own = {n: b for n, b in bounds.items() if not n.startswith(f'{label}.')}
    extended = [without.with_effect(name, at, **start) for start in promising]
    found = torque_error.fits_by_torque(extended, train, None, own, at=base.values)
    pairs = zip(extended, found, strict=True) if found else []
    return min(pairs, key=lambda pair: pair[1].deviance, default=None)


def _as_predicted(
    model: Model, problems: Sequence[Problem], residual: np.ndarray
) -> list[Problem]:
    """The motions with the torques that the base predicts in place of those measured.

    What acted is measured with noise, and that noise is in r too: a law of the measured torque
    would explain r by itself.
    """
    found, first = [], 0
    for problem in problems:
        motion = problem.motion
        rows = np.array([model.mechanism.joints[joint] for joint in model.mechanism.joints])
        basis = np.asarray(model.mechanism.kinematics(motion.setup).basis)
        last = first + len(motion.position)
        inputs = motion.inputs.copy()
        error = residual[first:last, problem.free] @ np.linalg.pinv(rows @ basis)
        inputs[:, : len(rows)] -= error
        acted = problem.acted - error @ rows @ basis
        begins = np.flatnonzero(motion.first)[1:]
        records = tuple(
            _less(samples, own)
            for samples, own in zip(motion.records, np.split(error, begins), strict=True)
        )
        motion = replace(motion, inputs=inputs, records=records)
        found.append(replace(problem, motion=motion, acted=acted))
        first = last
    return found


def _less(samples: Samples, error: np.ndarray) -> Samples:
    """Samples of a record less the torque error of its windows, (windows, drives)."""
    middle = len(samples.weights) // 2 + samples.stride * np.arange(len(error))
    at = np.arange(len(samples.inputs))
    inputs = samples.inputs.copy()
    for k, own in enumerate(error.T):
        inputs[:, k] -= np.interp(at, middle, own)
    return replace(samples, inputs=inputs)


class _Weightless(Urdf):
    """The joints of a robot without the bodies: what is left of its equations are the forces."""

    def recursion(self, q, v, a, p, up, loads=()):
        """Loads only have to be moved; a mass lets the equations be written down."""
        mass, taken = super().recursion(q, v, a, p, up, loads)
        return mass + ca.SX.eye(q.shape[0]), taken

    def masses(self, p):
        """None."""
        return {}

    def energies(self, q, v, p, setup, up, foot=None):
        """None."""
        return ca.SX(0), ca.SX(0)


def _without_bodies(model: Model) -> Model:
    """The joints of a robot: no effects, no bodies."""
    body = model.mechanism
    assert isinstance(body, Urdf)
    return Model(
        model.name, _Weightless(body.description, body.driven, body.rates, body.couplings), (),
        {p.name: model.quantities[p.name] for p in body.parameters}, {}, {}, '', {},
    )  # fmt: skip


def _columns(
    model: Model,
    weightless: Model,
    name: str,
    at: str | None,
    starts: Sequence[dict[str, float]],
    problems: Sequence[Problem],
    by_motion: Sequence[np.ndarray],
) -> list[np.ndarray] | None:
    """D of a candidate at each of its starts, (rows, n, numbers); None where it has none."""
    kind = LIBRARY[name]
    effect = kind(model.mechanism, at)
    # Without bodies gravity pulls at nothing: what turns it has no D either.
    if effect.states or set(effect.extra_inputs) & set(CLOCKS) or overrides(effect, 'up'):
        return None
    bare = weightless
    # What else acts on the same joint makes the load that some laws follow.
    for other in model.effects:
        if other.label != effect.label and other.site == effect.site and not other.states:
            bare = bare.with_effect(other.name, other.at, **model.values_of(other))
    from_starts = [bare.with_effect(name, at, **start) for start in starts]
    found = [
        [problem.of_all(d, 0.0) for d in _from_starts(from_starts, effect.label, problem, motion)]
        for problem, motion in zip(problems, by_motion, strict=True)
    ]
    return [np.concatenate(columns) for columns in zip(*found, strict=True)]


def _from_starts(
    models: Sequence[Model], label: str, problem: Problem, by_motion: np.ndarray
) -> list[np.ndarray]:
    """D for the motions of one set-up, from each start of an effect: in the same equations."""
    model, motion = models[0], problem.motion
    e = assemble(model, motion.setup)
    own = [
        k for k, n in enumerate(e.parameter_names)
        if n.startswith(f'{label}.') and model.declarations[n].free
    ]  # fmt: skip
    f = _by_parameters(e, own, [int(k) for k in np.flatnonzero(problem.free)])
    within = WindowTorque(e, e.torques, motion, own)
    found = []
    for start in models:
        p = parameter_vector(start, motion.setup)
        found.append(_one_column(f, p, problem, by_motion) + within.slope(p))
    return found


def _by_parameters(e: Equations, own: Sequence[int], sensors: Sequence[int]) -> ca.Function:
    """Derivatives by some parameters of forces, of what the sensors show, and of delays.

    Args:
        e: Of a robot without bodies.
        own: Places of the parameters.
        sensors: Which outputs show the m free coordinates.
    """
    moved = ca.vertcat(*(e.p[k] for k in own))
    m = e.coordinates
    s, ds, a = e.x[:m], e.x[m : 2 * m], e.acceleration
    seen = e.outputs[sensors] - s
    seen_rate = ca.jtimes(seen, s, ds)
    seen_acceleration = ca.jtimes(seen_rate, s, ds) + ca.jtimes(seen_rate, ds, a)
    # A sensor that shows more than there is: what is there is less than measured.
    shown = -ca.jacobian(ca.vertcat(seen, seen_rate, seen_acceleration), moved)
    late = ca.jacobian(ca.vertcat(e.input_delay, e.output_delays[sensors]), moved)
    return ca.Function(
        'columns', [e.x, e.u, a, e.p],
        [ca.densify(x) for x in (ca.jacobian(e.imbalance, moved), shown, late)],
    )  # fmt: skip


def _one_column(
    f: ca.Function, p: np.ndarray, problem: Problem, by_motion: np.ndarray
) -> np.ndarray:
    """D for the motions of one set-up, from one start, (rows, m, numbers)."""
    motion: Motion = problem.motion
    k, count = len(motion.position), f.size2_out(0)
    x = np.hstack([motion.position, motion.rate]).T
    u = motion.inputs[:, : f.size1_in(1)].T
    force, readings, delays = f.map(k)(x, u, motion.acceleration.T, p)
    force, readings, delays = (
        np.asarray(part).reshape(part.shape[0], k, count).transpose(1, 0, 2)
        for part in (force, readings, delays)
    )
    found = force + np.einsum('kij,kjc->kic', by_motion, readings)
    if np.any(delays):
        rise = _rise(problem.acted, motion)
        jerk = _rise(motion.acceleration, motion)
        found = found - delays[:, :1] * rise[:, :, None]
        ahead = np.hstack([motion.rate, motion.acceleration, jerk])
        each = np.tile(delays[:, 1:], (1, 3, 1))
        found = found + np.einsum('kij,kjc->kic', by_motion, each * ahead[:, :, None])
    return found


def _rise(values: np.ndarray, motion: Motion) -> np.ndarray:
    """Derivative by time along rows, where they follow each other."""
    rise = np.gradient(values, np.cumsum(motion.stride), axis=0)
    rise[motion.first] = 0.0
    rise[:-1][motion.first[1:]] = 0.0
    return rise


def _by_motion(problem: Problem, model: Model) -> np.ndarray:
    """Derivative of the torque error by position, rate and acceleration, (rows, m, 3 m)."""
    e, motion = problem.equations, problem.motion
    m = e.coordinates
    every = ca.vertcat(e.x[: 2 * m], e.acceleration)
    f = ca.Function(
        'by_motion', [e.x, e.u, e.acceleration, e.p],
        [ca.cse(ca.densify(ca.jacobian(e.imbalance, every)))],
    )  # fmt: skip
    k = len(motion.position)
    x = np.hstack([motion.position, motion.rate]).T
    p = parameter_vector(model, motion.setup)
    found = np.asarray(f.map(k)(x, motion.inputs.T, motion.acceleration.T, p))
    return found.reshape(m, k, 3 * m).transpose(1, 0, 2)


def _noise(problems: Sequence[Problem], by_motion: Sequence[np.ndarray]) -> np.ndarray:
    """Torque error that the noise of the encoders makes, for each coordinate, N m (N)."""
    squares = []
    for problem, slope in zip(problems, by_motion, strict=True):
        made = np.einsum('kij,kj->ki', slope**2, problem.motion.spread**2)
        squares.append(problem.of_all(made, 0.0))
    return np.sqrt(np.mean(np.vstack(squares), axis=0))


def _joint(place: str) -> str:
    """The joint of a place: of a sensor `JOINT_position`."""
    return place.removesuffix('_position').removesuffix('_velocity')
