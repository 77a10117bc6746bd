"""The function that a learned term turned out to be: over what, how large, even or odd, where.

Its standard deviation follows from that of the coefficients,

    var g(s) = (dg/dc) C (dg/dc)'                                                     (BAND)
"""

import math
from dataclasses import dataclass, field

import casadi as ca
import numpy as np

from cg_dynamics.effects.unmodelled import LearnedEffect
from cg_sysid.identification.fit_result import Fit

MOST_TURNS = 16  # waves in a turn that a short stretch of it is tried with
GRID = 121
ENDS = 0.005  # share of the samples at either end of the range that does not count as covered
RARE = 0.1  # share of an even spread of the samples from which a place of the grid counts as seen
SURE = 2.0  # standard deviations from which a value of the function counts
PURE = 0.9  # share of its power from which a function is called even or odd
SYMMETRIC = 0.3  # least share of the range on the other side of zero to judge that
MOST_OF_POWER = 0.9  # of the power of a function that lies in one stretch
VARIES = 0.25  # of its mean: a function that varies less is a constant
SHORT = 0.4  # share of the range up to which such a stretch is worth saying


@dataclass(frozen=True)
class Shape:
    """A learned function over what the records cover of its variable.

    Attributes:
        s: Grid of the variable, shape (n,); one period about zero of a function that repeats.
        value: g on it, shape (n,).
        sigma: Standard deviation of each value, shape (n,).
        seen: Where there are samples enough, shape (n,).
        covered: Lowest and highest value of the variable.
        mean: Mean of g over all samples.
        rms: Root mean square of g over all samples.
        peak: Largest magnitude on the grid, where it is seen and sure.
        even: Share of the power that is even about zero, 0 to 1; None where zero is not amid the
            range, or means nothing, as in time.
        stretch: Where nine tenths of the power lie, if that is a small part of the range.
    """

    s: np.ndarray = field(repr=False)
    value: np.ndarray = field(repr=False)
    sigma: np.ndarray = field(repr=False)
    seen: np.ndarray = field(repr=False)
    covered: tuple[float, float]
    mean: float
    rms: float
    peak: float
    even: float | None
    stretch: tuple[float, float] | None

    def turns(self, count: int) -> list[float]:
        """Periods in rad of the waves that fit the function best, whole numbers in a turn.

        For a function of an angle that covers too little of it to be learned as one that repeats,
        but a whole period at least: less is a shape, and any wave resembles it.
        """
        s, g = self.s[self.seen], self.value[self.seen]
        left = []
        low, high = self.covered
        for cycles in range(math.ceil(2 * math.pi / (high - low)), MOST_TURNS + 1):
            waves = np.column_stack([np.ones_like(s), np.cos(cycles * s), np.sin(cycles * s)])
            found = np.linalg.lstsq(waves, g, rcond=None)[0]
            left.append((float(((g - waves @ found) ** 2).sum()), cycles))
        return [2 * np.pi / cycles for _, cycles in sorted(left)[:count]]

    @property
    def constant(self) -> bool:
        """Whether it hardly varies over the samples."""
        return self.rms**2 - self.mean**2 < (VARIES * self.mean) ** 2

    @property
    def parity(self) -> str:
        """`even`, `odd`, or nothing where it is neither or cannot be said."""
        if self.even is None:
            return ''
        return 'even' if self.even >= PURE else 'odd' if self.even <= 1 - PURE else ''


def shape_of(effect: LearnedEffect, fit: Fit, variable: np.ndarray) -> Shape:
    """The function of a term as a fit found it.

    Args:
        effect: The term.
        fit: The fit of a model that has it.
        variable: Values of its variable along the records, shape (m,).
    """
    low, high = (float(x) for x in np.quantile(variable, (ENDS, 1 - ENDS)))
    if effect.kind == 'smooth':
        s = np.linspace(low, high, GRID)
        edges = np.concatenate([[variable.min()], (s[:-1] + s[1:]) / 2, [variable.max()]])
        seen = np.histogram(variable, edges)[0] > RARE * len(variable) / GRID
    else:
        period = fit.model.values[f'{effect.label}.period']
        s = np.linspace(-period / 2, period / 2, GRID)
        seen = np.ones(GRID, bool)
    value, sigma = function_of(effect, fit, s)
    at_samples, _ = function_of(effect, fit, variable)
    sure = np.where(seen & (np.abs(value) > SURE * sigma), value, 0.0)
    return Shape(
        s=s,
        value=value,
        sigma=sigma,
        seen=seen,
        covered=(low, high),
        mean=float(np.mean(at_samples)),
        rms=float(np.sqrt(np.mean(at_samples**2))),
        peak=float(np.abs(sure).max()),
        even=None if effect.variable == 'time' else _even(s, value, seen),
        stretch=_stretch(s, sure) if effect.kind == 'smooth' else None,
    )


def function_of(effect: LearnedEffect, fit: Fit, s: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Value and standard deviation (BAND) of the function at s, both of its shape (n,)."""
    p = {q.name: ca.SX.sym(q.name) for q in effect.parameters}
    x, stacked = ca.SX.sym('s'), ca.vertcat(*p.values())
    g = effect.law(x, p)
    law = ca.Function('g', [x, stacked], [g, ca.densify(ca.jacobian(g, stacked))])
    names = [f'{effect.label}.{name}' for name in p]
    value, slope = law(s[None, :], np.array([fit.model.values[name] for name in names]))
    by_parameter = np.asarray(slope).reshape(len(s), len(names))
    own = [i for i, u in enumerate(fit.unknowns) if u.name in names]
    chain = [fit.values[i] if fit.unknowns[i].logarithmic else 1.0 for i in own]
    places = [names.index(fit.unknowns[i].name) for i in own]
    by_unknown = by_parameter[:, places] * np.array(chain)
    covariance = fit.covariance[np.ix_(own, own)]
    variance = np.einsum('ni,ij,nj->n', by_unknown, covariance, by_unknown)
    spread = np.sqrt(np.clip(np.nan_to_num(variance, nan=np.inf), 0, None))
    return np.asarray(value).ravel(), spread


def _even(s: np.ndarray, value: np.ndarray, seen: np.ndarray) -> float | None:
    low, high = s[seen].min(), s[seen].max()
    reach = min(-low, high)
    if reach < SYMMETRIC * max(-low, high):
        return None
    half = np.linspace(0, reach, GRID)
    ahead, behind = np.interp(half, s, value), np.interp(-half, s, value)
    both = np.interp(half, s, seen) * np.interp(-half, s, seen)
    power = float(both @ (ahead**2 + behind**2))
    return float(both @ (ahead + behind) ** 2) / (2 * power) if power > 0 else None


def _stretch(s: np.ndarray, value: np.ndarray) -> tuple[float, float] | None:
    """The shortest stretch with nine tenths of the power, if it is short."""
    power = np.concatenate([[0.0], np.cumsum(value**2)])
    if power[-1] <= 0:
        return None
    starts = np.arange(len(s))
    stops = np.searchsorted(power, power[:-1] + MOST_OF_POWER * power[-1])
    lengths = np.where(stops < len(power), stops - starts, len(power))
    first = int(np.argmin(lengths))
    if lengths[first] > SHORT * len(s):
        return None
    return float(s[first]), float(s[stops[first] - 1])
