"""When did it happen, and how much: first guesses of what one record has of its own.

An event such as a push shows from its instant on. For every instant of a grid, the size of a
small event there that would lower the simulation error most, and by how much, is a linear
question: one sensitivity. Where the answer peaks, a fit of that record alone goes on from.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
import scipy

from cg_dynamics.assemble import parameter_vector
from cg_dynamics.effects.effect import TIME
from cg_dynamics.errors import DynamicsError
from cg_dynamics.model import Model
from cg_dynamics.rollout.compiled import compile_model
from cg_sysid.identification.data_set import DataSet, pieces
from cg_sysid.identification.fit_result import Fit
from cg_sysid.identification.identify import fit, in_data_set, score
from cg_sysid.identification.unknowns import IdentificationError, awake, own_unknowns
from cg_sysid.search import settings
from cg_sysid.search.nuisance import Bounds

SEEN = 1e-9  # share of what a size does that the initial motion could not do as well


def seek_events(
    model: Model,
    data_sets: Sequence[DataSet],
    label: str,
    known: Mapping[str, Mapping[str, float]] | None = None,
    elsewhere: Sequence[np.ndarray] = (),
) -> dict[str, dict[str, float]]:
    """DataSet name -> full name -> guess of its own value.

    Args:
        model: Has an effect of which every record has sizes and an instant; its other values are
            taken as they are.
        data_sets: Each is looked at by itself.
        label: Of the effect.
        known: What else each data set has of its own, and as far as it is known this.
        elsewhere: Sizes and instants in other data sets; they may be those of these as well.
    """
    sizes, instant = event_names(model, label)
    known = known or {}
    if data_sets and all(
        {*sizes, instant} <= set(known.get(data_set.name, ())) for data_set in data_sets
    ):
        return {data_set.name: dict(known[data_set.name]) for data_set in data_sets}
    seeking = _Seeking(model, sizes, instant, known)
    guesses = [seeking.alone(data_set) for data_set in data_sets]
    # What happened in one record may have happened at the same time in another.
    surest = sorted(guesses, key=lambda g: g.error / g.quiet)[: settings.EVENTS.followed]
    others = [*elsewhere, *(g.event for g in surest if g.error < g.quiet)]
    guesses = [seeking.follow(t, g, others) for t, g in zip(data_sets, guesses, strict=True)]
    return {
        data_set.name: seeking.beside(data_set, guess.event)
        for data_set, guess in zip(data_sets, guesses, strict=True)
    }


def event_names(model: Model, label: str) -> tuple[tuple[str, ...], str]:
    """Full names of the sizes that an effect has in each record, 0 where none, and the instant."""
    own = [p for p in model.effect(label).parameters if p.each == 'record']
    (instant,) = (p.name for p in own if p.neutral is None)
    sizes = tuple(f'{label}.{p.name}' for p in own if p.neutral is not None)
    return sizes, f'{label}.{instant}'


def undisturbed(model: Model, data_sets: Sequence[DataSet], bounds: Bounds) -> Fit | None:
    """Fit of a model to those pieces of the records in which nothing happens.

    An event that the model does not have pulls at all its numbers, and with such numbers it is
    not found. It spoils few pieces: the others are those that can be simulated (least trimmed
    squares).

    Returns:
        None where that makes no sense: many pieces cannot be simulated down to the noise
        (something is wrong all the time), or all can.
    """
    # Pieces would have to share what belongs to a record; and a drift is told by late pieces,
    # which a first, spoilt fit loses.
    if own_unknowns(model) or any(TIME in effect.extra_inputs for effect in model.effects):
        return None
    whole = [
        piece
        for t in data_sets
        for _, piece in pieces(model.mechanism, t, settings.EVENTS.piece_s)
    ]
    kept, found = whole, None
    try:
        for _ in range(settings.EVENTS.trimmings):
            found = fit(model, kept, bounds=bounds, iterations=settings.EVENTS.piece_iterations)
            errors = _piece_errors(found.model, whole)
            quiet = max(
                settings.NOISE.settled,
                float(np.quantile(errors, settings.EVENTS.kept, method='lower')),
            )
            kept = [piece for piece, e in zip(whole, errors, strict=True) if e <= quiet]
    except (IdentificationError, DynamicsError, np.linalg.LinAlgError):
        return None
    spoilt = len(whole) - len(kept)
    return found if spoilt and quiet == settings.NOISE.settled else None


def _piece_errors(model: Model, found: Sequence[DataSet]) -> np.ndarray:
    """chi2/N of each piece."""
    fitted = score(model, found)
    return np.nansum(fitted.mse * fitted.count, axis=1) / fitted.count.sum(axis=1)


@dataclass(frozen=True)
class _Guess:
    """Sizes and instant in a data set, and its error (chi2/N) with the event and without."""

    event: np.ndarray
    error: float
    quiet: float


@dataclass(frozen=True)
class _Seeking:
    """A search of single data sets for sizes and instant, beside what else is known of each."""

    model: Model
    sizes: tuple[str, ...]
    instant: str
    known: Mapping[str, Mapping[str, float]]

    @property
    def names(self) -> tuple[str, ...]:
        """Of an event's values, in order."""
        return (*self.sizes, self.instant)

    def beside(self, data_set: DataSet, event: np.ndarray) -> dict[str, float]:
        """All that the data set has of its own, by name."""
        named = dict(zip(self.names, map(float, event), strict=True))
        return {**self.known.get(data_set.name, {}), **named}

    def alone(self, data_set: DataSet) -> _Guess:
        """The best that this data set alone knows."""
        nothing = np.array([*(0.0 for _ in self.sizes), self.model.values[self.instant]])
        quiet = self._fit(data_set, nothing, 8)
        guess = _Guess(nothing, quiet.normalised_error, quiet.normalised_error)
        found = quiet.own_by_name([data_set])[data_set.name]
        _, motion = in_data_set(awake(self.model), quiet.motions[0])
        others = {name: value for name, value in found.items() if name not in self.names}
        model = self.model.with_values(others)
        starts = _small_events(model, data_set, motion, self.sizes, self.instant)
        return self.follow(data_set, guess, starts)

    def follow(self, data_set: DataSet, guess: _Guess, starts: Sequence[np.ndarray]) -> _Guess:
        """The best of a guess and the fits of this data set alone from each start."""
        for start in starts:
            try:
                found = self._fit(data_set, start, 16)
            except IdentificationError:
                continue
            own = found.own_by_name([data_set])[data_set.name]
            event = np.array([own[name] for name in self.names])
            inside = 0.0 <= event[-1] - data_set.since <= data_set.duration
            if inside and found.normalised_error < guess.error:
                guess = replace(guess, event=event, error=found.normalised_error)
        return guess

    def _fit(self, data_set: DataSet, event: np.ndarray, iterations: int) -> Fit:
        own = {data_set.name: self.beside(data_set, event)}
        return fit(self.model, [data_set], only=(), own=own, iterations=iterations, sure=False)


def _small_events(
    model: Model, data_set: DataSet, motion: np.ndarray, sizes: Sequence[str], instant: str
) -> list[np.ndarray]:
    """Sizes and instants of the events that lower the error most, best first."""
    compiled = compile_model(awake(model), data_set.setup)
    at = [compiled.parameter_names.index(name) for name in sizes]
    when = compiled.parameter_names.index(instant)
    p = parameter_vector(model, data_set.setup)
    p[at] = 0.0
    u = data_set.inputs_for(compiled.input_names)
    m2 = len(motion)
    x0, by_motion, _ = compiled.initial_sensitivity(motion, u[0], p)
    s0 = np.column_stack([by_motion, np.zeros((compiled.nx, len(sizes)))])
    columns = {name: m2 + k for k, name in enumerate(sizes)}
    column = np.array([columns.get(name, -1) for name in compiled.free])
    grid = _instants(model.with_values(dict.fromkeys(sizes, 0.0)), data_set)
    gains, found = np.zeros(len(grid)), np.zeros((len(grid), len(sizes)))
    for k, t in enumerate(grid):
        p[when] = data_set.since + t
        normal, _, _ = compiled.normal(
            data_set.time, u, x0, s0, p, column, data_set.outputs, 1 / data_set.sigma
        )
        h, g = normal.hessian, normal.gradient
        # What the initial motion could do as well does not count.
        by_start = np.linalg.lstsq(h[:m2, :m2], np.column_stack([h[:m2, m2:], g[:m2]]), rcond=None)
        own = np.column_stack([h[m2:, m2:], g[m2:]]) - h[m2:, :m2] @ by_start[0]
        own_h, own_g = own[:, :-1], own[:, -1]
        seen = np.diag(own_h) > SEEN * np.diag(h)[m2:]
        own_h = own_h[np.ix_(seen, seen)]
        found[k, seen] = -np.linalg.lstsq(own_h, own_g[seen], rcond=SEEN)[0]
        gains[k] = -own_g @ found[k]
    peaks, _ = scipy.signal.find_peaks(np.concatenate([[0.0], gains, [0.0]]))
    order = sorted(peaks - 1, key=lambda k: -gains[k])
    return [
        np.array([*found[k], data_set.since + grid[k]]) for k in order[: settings.EVENTS.followed]
    ]


def _instants(model: Model, data_set: DataSet) -> np.ndarray:
    """Instants in s from the first row, at which something may have happened.

    All, or those about spoilt pieces.
    """
    grid = np.arange(0.0, data_set.duration, settings.EVENTS.grid_s)
    found = pieces(model.mechanism, data_set, settings.EVENTS.piece_s)
    try:
        errors = _piece_errors(model, [piece for _, piece in found])
    except IdentificationError:
        return grid  # too short for pieces, or none can be simulated
    bad = errors > settings.NOISE.settled * max(1.0, float(np.median(errors)))
    spoilt = np.array([begin for begin, _ in found])[bad]
    near = (grid[:, None] > spoilt - settings.EVENTS.before_s) & (
        grid[:, None] < spoilt + settings.EVENTS.piece_s
    )
    return grid[near.any(axis=1)] if len(spoilt) else grid
