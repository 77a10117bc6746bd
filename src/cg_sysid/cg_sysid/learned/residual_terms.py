"""Which function of which variable could be missing: learned terms on short pieces of motion.

By (RESP) of response.py what a model misses on a piece is linear in a missing torque or sensor
error, and a learned term is linear in its coefficients: so a ridge regression fits it, beside
all parameters of the model,

    min over dtheta, c of  w |r - J dtheta - H g(c)|^2 + |theta - theta_file|^2 + |c|^2    (SKETCH)

each squared distance in its own standard deviations. How well a term does is asked twice: what is
learned on the training records is judged on those held out, and the other way round. The same
choice says how smooth a function should be and with which period it repeats.
"""

import functools
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import casadi as ca
import numpy as np

from cg_dynamics.effects import UNMODELLED
from cg_dynamics.effects.unmodelled import COSINES, JointTerm, LearnedEffect, SensorTerm
from cg_dynamics.model import Model
from cg_sysid.identification.data_set import DataSet
from cg_sysid.identification.information_criterion import weight_of
from cg_sysid.learned.linear_response import SAMPLES_HZ, Piece, Pieces, Response

BEYOND = 0.05  # share of the range of data by which a smooth function goes beyond them
ROUGHNESS = (1.5, 3.0, 6.0, 12.0, 24.0, 48.0)  # half waves beyond which coefficients fade
SLACK = 10.0  # a coefficient may be so much larger than what explains everything by itself
OVERSAMPLED = 2.0  # frequencies of the sweep per width of a spectral line
PROMISING = 0.95  # share of the error that one wave of a series may leave
REFINED = 9  # frequencies between two neighbours of the sweep
MOST_CYCLES = 400.0  # per revolution
WHIRLS = 20 * np.pi  # rad, of a joint that turns on and on
MOST_STEPS = 200  # of a torque, over its range
FASTEST_HZ = {False: 20.0, True: 60.0}  # in time: of a torque, of a sensor error
FEWEST_PERIODS = 2.5  # seen in the data; less is a shape, not a repetition
LONGER = 0.7  # share of the error that a multiple of a period may leave, or else it is not meant
REPEATS = 0.1  # share of the response to a wave that straight lines must not take (beside_lines)
NEVER = 1e-3  # range of a variable, in its unit, below which nothing is learned over it
Fold = dict[bool, np.ndarray]
NONE = np.zeros(0)


@dataclass(frozen=True)
class Term:
    """A learned term, as the pieces suggest it.

    Attributes:
        effect: Where it acts and what it follows.
        fixed: What its law needs beyond coefficients: low and high, or period.
        tolerances: What is believed about each coefficient, one standard deviation.
        start: Each coefficient as the pieces have it.
        error: What is left of the error of other records, chi2 per sample.
    """

    effect: LearnedEffect
    fixed: dict[str, float]
    tolerances: dict[str, float]
    start: dict[str, float]
    error: float

    @property
    def label(self) -> str:
        """Label of the effect."""
        return self.effect.label

    def added_to(self, model: Model) -> Model:
        """The model with the term in it."""
        extended = model.with_effect(self.effect.name, self.effect.at, **self.fixed, **self.start)
        quantities = dict(extended.quantities)
        for name, value in self.tolerances.items():
            full = f'{self.label}.{name}'
            quantities[full] = replace(quantities[full], tolerance=value)
        return replace(extended, quantities=quantities)


class Sketches:
    """Learned terms, compared on pieces.

    Args:
        pieces: All records in pieces.
        data_sets: The records, those to train on first.
    """

    def __init__(self, pieces: Pieces, data_sets: Sequence[DataSet]):
        unknowns = pieces.unknowns
        self.data_sets, self.body = data_sets, pieces.model.mechanism
        values = [pieces.model.values[u.name] for u in unknowns]
        chain = np.array(
            [v if u.logarithmic else 1.0 for u, v in zip(unknowns, values, strict=True)]
        )
        self.pieces = [replace(p, parameters=p.parameters * chain) for p in pieces.all]
        self.precision = np.array([u.tolerance**-2.0 for u in unknowns])
        self.centre = np.array(
            [u.to_coordinate(u.prior) - u.to_coordinate(v)
             for u, v in zip(unknowns, values, strict=True)]
        )  # fmt: skip
        self.swept: dict[tuple, tuple[np.ndarray, np.ndarray]] = {}
        self.responses: dict[tuple, list[Response]] = {}
        k = len(unknowns)
        self.squares, self.samples = {False: 0.0, True: 0.0}, {False: 0, True: 0}
        self.alone: tuple[Fold, Fold] = (
            {held: np.zeros((1, k, k)) for held in (False, True)},
            {held: np.zeros((1, k)) for held in (False, True)},
        )
        for p in self.pieces:
            self.squares[p.held] += float(p.missed @ p.missed)
            self.samples[p.held] += p.degrees
            self.alone[0][p.held] += p.parameters.T @ p.parameters
            self.alone[1][p.held] += p.parameters.T @ p.missed

    @functools.cached_property
    def nothing(self) -> float:
        """What is left with no term, parameters adjusted: chi2 per sample of other records."""
        return float(self._errors(self.alone, NONE[None, :])[0])

    def all(self) -> list[Term]:
        """Every term that these records could show, best first."""
        found: list[Term] = []
        for effect in self._effects():
            values = np.concatenate([self._variable(effect, piece) for piece in self.pieces])
            if not len(values):
                continue  # the error of a sensor that was not recorded
            low, high = float(values.min()), float(values.max())
            if high - low < NEVER:
                continue
            if effect.kind == 'smooth':
                found.append(self._smooth(effect, low, high))
            elif effect.kind == 'periodic':
                found += self._periodic(effect, high - low)
            else:
                found += self._vibrating(effect, high - low)
        return sorted(found, key=lambda term: term.error)

    def _effects(self) -> Iterator[LearnedEffect]:
        stances = {data_set.setup.stance for data_set in self.data_sets}
        for cls in UNMODELLED.values():
            for site in cls.sites(self.body):
                # With one leg always standing, "the leg that stands" is another name for it.
                if site == 'stance' and len(stances) == 1:
                    continue
                # An error that repeats belongs to the disc that turns.
                if cls.kind == 'periodic' and ':' in site:
                    continue
                yield cls(self.body, site)

    # --- what a term does to a piece -----------------------------------------------------------

    def _variable(self, effect: LearnedEffect, piece: Piece) -> np.ndarray:
        if not isinstance(effect, SensorTerm):
            return piece.at_slots[effect.follows]
        channel = self.body.outputs.index(effect.site.partition(':')[0])
        return piece.at_samples[effect.follows][piece.samples == channel]

    def _responses(self, effect: LearnedEffect) -> list[Response]:
        """How each piece responds to the function of a term."""
        place = effect.site.partition(':')[0]
        if isinstance(effect, JointTerm):
            found = zip(self._responses_at(place, sensor=False, joint=True), self.pieces,
                        strict=True)  # fmt: skip
            return [response.times(self._carrier(effect, piece)) for response, piece in found]
        return self._responses_at(place, sensor=isinstance(effect, SensorTerm), joint=False)

    def _responses_at(self, place: str, sensor: bool, joint: bool) -> list[Response]:
        """To errors of a sensor, to torques at a joint, or, where neither is asked, on a leg."""
        key = place, sensor, joint
        if key in self.responses:
            return self.responses[key]
        found = []
        for piece in self.pieces:
            if sensor:
                found.append(piece.to_error(self.body.outputs.index(place)))
                continue
            leg = self.data_sets[piece.record].setup.stance if place == 'stance' else place
            row = self.body.joints[place] if joint else np.eye(2)[self.body.bodies.index(leg)]
            found.append(piece.to_torque(np.array(row)))
        self.responses[key] = found
        return found

    def _carrier(self, effect: JointTerm, piece: Piece) -> np.ndarray:
        joint = effect.site.partition(':')[0]
        rate = piece.at_slots[f'rate:{joint}']
        if effect.carrier == 'friction':
            transition = next(p for p in effect.parameters if p.name == 'transition_rate')
            return -np.tanh(rate / transition.default)
        if effect.carrier == 'damping':
            return -rate
        if effect.carrier == 'gain':
            return piece.at_slots[f'torque:{joint}']
        return np.ones(len(rate))

    # --- the three laws -----------------------------------------------------------------------

    def _smooth(self, effect: LearnedEffect, low: float, high: float) -> Term:
        margin = BEYOND * (high - low)
        low, high = low - margin, high + margin
        waves = np.arange(COSINES)
        bases = []
        for piece in self.pieces:
            z = np.clip((self._variable(effect, piece) - low) / (high - low), 0, 1)
            bases.append(np.cos(np.pi * np.outer(z, waves)))
        sums = self._sums(effect, bases)
        tolerances = self._size(sums) / (1 + (waves / np.array(ROUGHNESS)[:, None]) ** 2)
        errors = self._errors(sums, tolerances)
        best = int(np.argmin(errors))
        fixed = {'low': low, 'high': high}
        return self._term(effect, fixed, sums, tolerances[best], float(errors[best]))

    def _periodic(self, effect: LearnedEffect, span: float) -> list[Term]:
        frequencies = self._frequencies(effect, span)
        if not len(frequencies):
            return []
        errors = self._sweep(effect, frequencies)[0]
        if errors.min() > PROMISING * self.nothing:
            return []
        best = float(frequencies[int(np.argmin(errors))])
        found = self._best_series(effect, best, span)
        for divisor in (2, 3):
            # The strongest wave need not be the first of its series, but every series is also one
            # of twice the period.
            if best / divisor >= FEWEST_PERIODS / span:
                longer = self._best_series(effect, best / divisor, span)
                found = longer if longer.error < LONGER * found.error else found
        return [found] if self._repeats(found) else []

    def _best_series(self, effect: LearnedEffect, about: float, span: float) -> Term:
        """The series of a frequency within a step of the sweep."""
        nearby = about + np.linspace(-1, 1, REFINED) / (OVERSAMPLED * span)
        series = [self._series(effect, float(frequency)) for frequency in nearby]
        return min(series, key=lambda term: term.error)

    def _series(self, effect: LearnedEffect, frequency: float) -> Term:
        harmonics = np.arange(1, (len(effect.coefficients) + 1) // 2 + 1)[
            : len(effect.coefficients) // 2
        ]
        bases = []
        for piece in self.pieces:
            s = self._variable(effect, piece)
            turn = 2 * np.pi * frequency * np.outer(s, harmonics)
            waves = np.stack([np.cos(turn), np.sin(turn)], axis=2).reshape(len(s), -1)
            bases.append(np.hstack([np.ones((len(s), 1)), waves]))
        sums = self._sums(effect, bases)
        tolerances = np.full(len(effect.coefficients), self._size(sums))
        error = float(self._errors(sums, tolerances[None, :])[0])
        return self._term(effect, {'period': 1 / frequency}, sums, tolerances, error)

    def _term(
        self,
        effect: LearnedEffect,
        fixed: dict[str, float],
        sums: tuple[Fold, Fold],
        tolerances: np.ndarray,
        error: float,
    ) -> Term:
        found = self._solve(sums, tolerances)[len(self.precision) :]
        names = effect.coefficients
        return Term(
            effect,
            fixed,
            dict(zip(names, tolerances.tolist(), strict=True)),
            dict(zip(names, found.tolist(), strict=True)),
            error,
        )

    def _repeats(self, term: Term) -> bool:
        """Whether motions respond to a series as to one, and not as to a few straight lines."""
        variables = [self._variable(term.effect, piece) for piece in self.pieces]
        values = {**term.fixed, **term.start}
        laws = (term.effect.law(ca.SX(s), values) for s in variables)
        waves = [np.asarray(ca.DM(g)).ravel() for g in laws]
        recordings = [self.data_sets[piece.record].recording for piece in self.pieces]
        share = beside_lines(self._responses(term.effect), variables, waves, recordings)
        return share > REPEATS

    def _vibrating(self, effect: LearnedEffect, span: float) -> list[Term]:
        frequencies = self._frequencies(effect, span)
        if not len(frequencies):
            return []
        errors = self._sweep(effect, frequencies)[1]
        best = int(np.argmin(errors))
        period = 1 / float(frequencies[best])
        return [Term(effect, {'period': period}, {}, {}, float(errors[best]))]

    def _frequencies(self, effect: LearnedEffect, span: float) -> np.ndarray:
        fastest = self._fastest(effect, span)
        if effect.variable == 'angle' and span > WHIRLS:
            # Thousands of frequencies would be told apart; what turns on repeats in whole turns.
            return np.arange(1, fastest * 2 * np.pi + 0.5) / (2 * np.pi)
        return np.arange(FEWEST_PERIODS / span, fastest, 1 / (OVERSAMPLED * span))

    def _fastest(self, effect: LearnedEffect, span: float) -> float:
        if effect.variable == 'angle':
            return MOST_CYCLES / (2 * np.pi)
        if effect.variable == 'torque':
            return MOST_STEPS / span
        step = max(float(np.median(np.diff(data_set.time))) for data_set in self.data_sets)
        return min(FASTEST_HZ[isinstance(effect, SensorTerm)], 0.4 / step)

    # --- sweeps -------------------------------------------------------------------------------

    def _sweep(
        self, effect: LearnedEffect, frequencies: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray]:
        """Error left by a mean and one wave of each frequency, shapes (frequencies,).

        First with the same wave in all records, learned on one side and judged on the other, then
        with a phase of each record's own, learned on every second piece and judged on the others.
        """
        key = (type(effect).__bases__, effect.site, effect.unit, effect.variable)
        if key in self.swept:
            return self.swept[key]
        k, count = len(self.precision) + 1, len(frequencies)
        shared = self._solve(self.alone, NONE)
        responses = self._responses(effect)
        across = {held: np.zeros((k + 1, 2, count)) for held in (False, True)}
        among = {held: np.zeros((2, 2, count)) for held in (False, True)}
        own: dict[tuple[int, bool], tuple[np.ndarray, np.ndarray]] = {}
        left = 0.0
        for i, (piece, response) in enumerate(zip(self.pieces, responses, strict=True)):
            waves = _waves(self._variable(effect, piece), frequencies)
            mean = response.with_constant()
            known = np.vstack([response.parameters, mean, response.missed])
            beside = (known @ waves).transpose(1, 0, 2)
            squared, taken = response.squared(waves), response.start @ waves
            power = np.einsum('ain,bin->abn', squared, squared)
            power -= np.einsum('ain,bin->abn', taken, taken)
            across[piece.held] += beside
            among[piece.held] += power
            sums = own.setdefault(
                (piece.record, i % 2 == 0), (np.zeros((2, 2, count)), np.zeros((2, count)))
            )
            sums[0].__iadd__(power)
            sums[1].__iadd__(beside[k] - np.tensordot(shared, beside[: k - 1], (0, 0)))
            rest = piece.missed - piece.parameters @ shared
            left += float(rest @ rest)
        h, g = self._sums(effect, [np.ones((len(r.missed), 1)) for r in responses])
        for held in (False, True):
            h[held] = _bordered(h[held], across[held][:k].transpose(2, 0, 1),
                                among[held].transpose(2, 0, 1))  # fmt: skip
            g[held] = np.hstack([np.repeat(g[held], count, axis=0), across[held][k].T])
        together = self._errors((h, g), np.full((count, 3), np.inf))
        self.swept[key] = together, self._own_phases(own, np.full(count, left))
        return self.swept[key]

    def _own_phases(
        self, own: dict[tuple[int, bool], tuple[np.ndarray, np.ndarray]], errors: np.ndarray
    ) -> np.ndarray:
        for (record, even), (h, g) in own.items():
            if (record, not even) not in own:
                continue
            h, g = h.transpose(2, 0, 1), g.T
            learned, target = (part.T for part in own[record, not even])
            ridge = 1e-9 * np.trace(learned, axis1=1, axis2=2)[:, None, None] + 1e-300
            x = np.linalg.solve(learned + ridge * np.eye(2), target[:, :, None])[..., 0]
            errors = errors + ((np.matmul(h, x[:, :, None])[..., 0] - 2 * g) * x).sum(axis=1)
        return errors / sum(self.samples.values())

    # --- ridge regression ---------------------------------------------------------------------

    def _size(self, sums: tuple[Fold, Fold]) -> float:
        """Standard deviation that is no restriction: far beyond what explains everything."""
        k = len(self.precision)
        powers = [np.diag(h[0])[k:] for h in sums[0].values()]
        power = float(np.sum(powers)) / max(len(powers[0]), 1)
        return SLACK * float(np.sqrt(sum(self.squares.values()) / max(power, 1e-300)))

    def _sums(self, effect: LearnedEffect, bases: Sequence[np.ndarray]) -> tuple[Fold, Fold]:
        """Normal equations of parameters and coefficients on either side, with one batch axis.

        Args:
            effect: The term.
            bases: Of each piece, the functions where they act, shape (instants, coefficients).
        """
        k, n = len(self.precision), bases[0].shape[1]
        across = {held: np.zeros((1, k, n)) for held in (False, True)}
        among = {held: np.zeros((1, n, n)) for held in (False, True)}
        missed = {held: np.zeros((1, n)) for held in (False, True)}
        responses = self._responses(effect)
        for piece, response, basis in zip(self.pieces, responses, bases, strict=True):
            across[piece.held] += response.parameters @ basis
            among[piece.held] += response.among(basis)
            missed[piece.held] += response.missed @ basis
        h, g = self.alone
        return (
            {held: _bordered(h[held], across[held], among[held]) for held in h},
            {held: np.hstack([g[held], missed[held]]) for held in g},
        )

    def _errors(self, sums: tuple[Fold, Fold], tolerances: np.ndarray) -> np.ndarray:
        """What each side leaves of the other, chi2 per sample, shape (batch,).

        Args:
            sums: Normal equations, (1 or batch, k, k) and (1 or batch, k).
            tolerances: Of the coefficients, shape (1 or batch, coefficients).
        """
        h, g = sums
        batch = max(len(tolerances), len(g[False]))
        precision = np.empty((batch, g[False].shape[1]))
        precision[:, : len(self.precision)] = self.precision
        precision[:, len(self.precision) :] = tolerances**-2.0
        pull = np.zeros_like(precision)
        pull[:, : len(self.precision)] = self.precision * self.centre
        total = np.zeros(batch)
        for learn in (False, True):
            x = np.zeros_like(pull)
            for _ in range(3):
                # The weight of the data follows what is left, as in the identification.
                left = self._left(h, g, x, learn) / max(self.samples[learn], 1)
                weight = weight_of(left, 1 / SAMPLES_HZ)
                a = weight[:, None, None] * h[learn] + _diagonal(precision)
                scale = np.sqrt(np.maximum(np.einsum('bii->bi', a), 1e-300))
                a = a / (scale[:, :, None] * scale[:, None, :]) + 1e-12 * np.eye(a.shape[1])
                b = (weight[:, None] * g[learn] + pull) / scale
                x = np.linalg.solve(a, b[:, :, None])[..., 0] / scale
            total += self._left(h, g, x, not learn)
        return total / sum(self.samples.values())

    def _solve(self, sums: tuple[Fold, Fold], tolerances: np.ndarray) -> np.ndarray:
        """Parameters and coefficients from all pieces, shape (k,)."""
        h, g = (part[False][0] + part[True][0] for part in sums)
        precision = np.concatenate([self.precision, tolerances**-2.0])
        pull = np.concatenate([self.precision * self.centre, np.zeros(len(tolerances))])
        weight, samples = 1.0, sum(self.samples.values())
        for _ in range(3):
            a = weight * h + np.diag(precision)
            scale = np.sqrt(np.maximum(np.diag(a), 1e-300))
            b = (weight * g + pull) / scale
            x = np.linalg.lstsq(a / np.outer(scale, scale), b, rcond=1e-12)[0] / scale
            left = sum(self.squares.values()) + x @ h @ x - 2 * g @ x
            weight = float(weight_of(left / samples, 1 / SAMPLES_HZ))
        return x

    def _left(self, h: Fold, g: Fold, x: np.ndarray, side: bool) -> np.ndarray:
        curved = np.matmul(h[side], x[:, :, None])[..., 0]
        return self.squares[side] + ((curved - 2 * g[side]) * x).sum(axis=1)


def beside_lines(
    responses: Sequence[Response],
    variables: Sequence[np.ndarray],
    functions: Sequence[np.ndarray],
    recordings: Sequence[str],
) -> float:
    """Share of the response to a function that no straight line in each recording takes, 0 to 1.

    Of a wave that passes faster than a motion can follow its mean is all that acts, and through
    two values of its variable there is a line.

    Args:
        responses: Of each piece, to a forcing where the function acts.
        variables: Of each piece, what the function follows, shape (instants,).
        functions: Of each piece, the function, shape (instants,).
        recordings: Of each piece, the recording that it is cut from.
    """
    powers: dict[str, np.ndarray] = {}
    for response, s, g, name in zip(responses, variables, functions, recordings, strict=True):
        together = response.among(np.column_stack([g, np.ones(len(g)), s]))
        powers[name] = powers.get(name, 0.0) + together
    left = [
        p[0, 0] - p[0, 1:] @ np.linalg.pinv(p[1:, 1:], hermitian=True) @ p[1:, 0]
        for p in powers.values()
    ]
    return float(sum(left) / max(sum(p[0, 0] for p in powers.values()), 1e-300))


def _waves(s: np.ndarray, frequencies: np.ndarray) -> np.ndarray:
    """Cosines and sines of one turn per period, shape (2, len(s), frequencies).

    Frequencies lie at equal distances: each is one of a few, turned on by one of a few steps, so
    that few cosines are computed.
    """
    count = len(frequencies)
    step = float(frequencies[1] - frequencies[0]) if count > 1 else 0.0
    block = max(1, round(count**0.5))
    turn = 2 * np.pi * np.outer(s, frequencies[::block])
    on = 2 * np.pi * step * np.outer(s, np.arange(block))
    cosine, sine = np.cos(turn)[:, :, None], np.sin(turn)[:, :, None]
    more, less = np.cos(on)[:, None], np.sin(on)[:, None]
    found = np.stack([cosine * more - sine * less, sine * more + cosine * less])
    return found.reshape(2, len(s), -1)[:, :, :count]


def _bordered(h: np.ndarray, across: np.ndarray, among: np.ndarray) -> np.ndarray:
    """[[h, across], [across^T, among]] of each of a batch; of h there may be one for all."""
    batch, k, n = across.shape
    found = np.empty((batch, k + n, k + n))
    found[:, :k, :k], found[:, :k, k:], found[:, k:, k:] = h, across, among
    found[:, k:, :k] = across.transpose(0, 2, 1)
    return found


def _diagonal(values: np.ndarray) -> np.ndarray:
    return values[:, :, None] * np.eye(values.shape[1])
