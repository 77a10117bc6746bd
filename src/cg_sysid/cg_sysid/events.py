"""When did it happen, and how much: first guesses of what one record has of its own.

An event such as a push shows from its instant on. For every instant of a grid, the size of a
small event there that would lower the simulation error most, and by how much, is a linear
question: one sensitivity. Where the answer peaks, a fit of that record alone goes on from.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.signal import find_peaks

from cg_dynamics.assemble import parameter_vector
from cg_dynamics.compiled import compile_model
from cg_dynamics.model import Model
from cg_sysid.identify import fit
from cg_sysid.trial import Trial
from cg_sysid.unknowns import IdentificationError, Unknown, awake, own_unknowns

GRID_S = 0.2
FOLLOWED = 3  # peaks from which a fit goes on


def seek_events(
    model: Model, trials: Sequence[Trial], elsewhere: Sequence[np.ndarray] = ()
) -> dict[str, np.ndarray]:
    """Trial name -> guess of its own values, shape (len(own_unknowns(model)),).

    Args:
        model: Has one effect of which every record has a size and an instant; its other values
            are taken as they are.
        trials: Each is looked at by itself.
        elsewhere: What happened in other trials; it may have happened in these as well.
    """
    own = own_unknowns(model)
    if not own:
        return {}
    guesses = [_alone(model, trial, own) for trial in trials]
    # What happened in one record may have happened at the same time in another.
    surest = sorted(guesses, key=lambda g: g.error / g.quiet)[:FOLLOWED]
    others = [*elsewhere, *(g.own for g in surest if g.error < g.quiet)]
    guesses = [_follow(model, t, g, others) for t, g in zip(trials, guesses, strict=True)]
    return {trial.name: guess.own for trial, guess in zip(trials, guesses, strict=True)}


@dataclass(frozen=True)
class _Guess:
    """Own values of a trial, and its error (chi2/N) with them and with no event."""

    own: np.ndarray
    error: float
    quiet: float


def _alone(model: Model, trial: Trial, own: Sequence[Unknown]) -> _Guess:
    nothing = np.array([0.0, own[1].prior])
    quiet = fit(model, [trial], only=(), own={trial.name: nothing}, iterations=8)
    guess = _Guess(nothing, quiet.normalised_error, quiet.normalised_error)
    motion = quiet.motions[0][: -len(own)]
    return _follow(model, trial, guess, _small_events(model, trial, motion, own))


def _follow(model: Model, trial: Trial, guess: _Guess, starts: Sequence[np.ndarray]) -> _Guess:
    """The best of a guess and the fits of this record alone from each start."""
    own = own_unknowns(model)
    for start in starts:
        try:
            found = fit(model, [trial], only=(), iterations=16, own={trial.name: start})
        except IdentificationError:
            continue
        values = found.motions[0][-len(own) :]
        inside = 0.0 <= values[1] <= trial.duration
        if inside and found.normalised_error < guess.error:
            guess = replace(guess, own=values, error=found.normalised_error)
    return guess


def _small_events(
    model: Model, trial: Trial, motion: np.ndarray, own: Sequence[Unknown]
) -> list[np.ndarray]:
    """Sizes and instants of the events that lower the error most, best first."""
    compiled = compile_model(awake(model), trial.setup)
    size, instant = (compiled.parameter_names.index(u.name) for u in own)
    p = parameter_vector(model, trial.setup)
    p[size] = 0.0
    u = trial.inputs_for(compiled.input_names)
    m2 = len(motion)
    x0, by_motion, _ = compiled.initial_sensitivity(motion, u[0], p)
    s0 = np.column_stack([by_motion, np.zeros(compiled.nx)])
    column = np.where(np.array(compiled.free) == own[0].name, m2, -1)
    grid = np.arange(0.0, trial.duration, GRID_S)
    gains, sizes = np.zeros(len(grid)), np.zeros(len(grid))
    for k, t in enumerate(grid):
        p[instant] = t
        normal, _, _ = compiled.normal(
            trial.time, u, x0, s0, p, column, trial.outputs, 1 / trial.sigma
        )
        h, g = normal.hessian, normal.gradient
        # What the initial motion could do as well does not count.
        own_h = h[m2, m2] - h[m2, :m2] @ np.linalg.lstsq(h[:m2, :m2], h[:m2, m2], rcond=None)[0]
        own_g = g[m2] - h[m2, :m2] @ np.linalg.lstsq(h[:m2, :m2], g[:m2], rcond=None)[0]
        if own_h > 1e-9 * h[m2, m2]:
            gains[k], sizes[k] = own_g**2 / own_h, -own_g / own_h
    peaks, _ = find_peaks(np.concatenate([[0.0], gains, [0.0]]))
    order = sorted(peaks - 1, key=lambda k: -gains[k])
    return [np.array([sizes[k], grid[k]]) for k in order[:FOLLOWED]]
