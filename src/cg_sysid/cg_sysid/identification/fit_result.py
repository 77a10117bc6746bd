"""What an identification found: values, how sure they are, and what a person should know of it."""

from collections.abc import Collection, Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np

from cg_dynamics.model import Model
from cg_sysid.identification.data_set import DataSet
from cg_sysid.identification.unknowns import Unknown

ORDER = 0.5  # relative standard deviation from which not even the order of a number is known


@dataclass(frozen=True)
class Fit:
    """Result of an identification.

    Attributes:
        model: The model with the identified values and their standard deviations.
        unknowns: What was identified.
        values: Identified value of each unknown.
        covariance: Of the unknowns' coordinates (log where logarithmic), shape (k, k).
        information: Share of each unknown's certainty that comes from data, 0 (all from the
            model file's belief) to 1.
        motions: What each data set has of its own: initial motion, (2m,), how far extra states are
            from settled at its start (`unsettled_states`, in their spreads), then one value for
            each of `own`.
        own: Parameters of which every record has a value of its own (a push's instant).
        own_sigmas: Standard deviation of these, shape (len(own),) for each data set.
        cost: Final cost J, in squared noise standard deviations.
        mse: Mean squared error of each data set and output, in squared noise, shape (n, ny).
        count: Samples behind `mse`.
        inflation: Variance of the residual over that of the noise, as used in the weights.
        horizon: Length of the records used, in s.
        evaluations: Number of evaluations of all records.
        seconds: Wall time.
        refinement: Integration steps that were taken in place of one.
        converged: False if it stopped at the limit of iterations.
        warnings: What a person should know: bounds, correlations, unidentifiable directions.
        starts: What the starts of extra states cost as evidence, in the unit of `belief`.
    """

    model: Model
    unknowns: tuple[Unknown, ...]
    values: np.ndarray
    covariance: np.ndarray
    information: np.ndarray
    motions: tuple[np.ndarray, ...]
    own: tuple[Unknown, ...]
    own_sigmas: tuple[np.ndarray, ...]
    cost: float
    mse: np.ndarray
    count: np.ndarray
    inflation: float
    horizon: float
    evaluations: int
    seconds: float
    refinement: float
    converged: bool
    warnings: tuple[str, ...] = ()
    starts: float = 0.0

    @property
    def sigmas(self) -> np.ndarray:
        """Standard deviation of each value, in its unit, shape (k,)."""
        spread = np.sqrt(np.clip(np.diag(self.covariance), 0, None))
        pairs = zip(self.unknowns, self.values, strict=True)
        factor = [v if u.logarithmic else 1.0 for u, v in pairs]
        return spread * np.array(factor)

    @property
    def undetermined(self) -> tuple[str, ...]:
        """Positive numbers without a belief of which not even the order is known."""
        relative = np.sqrt(np.clip(np.diag(self.covariance), 0, None))
        return tuple(
            u.name
            for u, spread in zip(self.unknowns, relative, strict=True)
            if u.logarithmic and not np.isfinite(u.tolerance) and spread > ORDER
        )

    def own_by_name(self, data_sets: Sequence[DataSet]) -> dict[str, dict[str, float]]:
        """What was found of each data set alone: its name -> full name -> value, within range."""
        count = len(self.own)
        return {
            data_set.name: {
                u.name: float(np.clip(v, u.lower, u.upper))
                for u, v in zip(self.own, motion[len(motion) - count :], strict=True)
            }
            for data_set, motion in zip(data_sets, self.motions, strict=True)
            if count
        }

    @property
    def squares(self) -> float:
        """Squared error over noise variance, all data sets and outputs together."""
        return float((self.mse * self.count).sum())

    @property
    def belief(self) -> float:
        """Squared distance from what the model file believes, in its standard deviations."""
        return sum(
            ((u.to_coordinate(v) - u.to_coordinate(u.prior)) / u.tolerance) ** 2
            for u, v in zip(self.unknowns, self.values, strict=True)
            if np.isfinite(u.tolerance)
        )

    @property
    def misfit(self) -> float:
        """chi2 and belief: fits that leave the same error may differ in what nobody believes.

        Without weights, so that fits under different ones can be compared.
        """
        return self.normalised_error * float(self.count.sum()) + self.belief

    @property
    def numbers(self) -> dict[str, float]:
        """Identified values by full name."""
        return {u.name: float(v) for u, v in zip(self.unknowns, self.values, strict=True)}

    @property
    def normalised_error(self) -> float:
        """Mean squared error over noise variance, all data sets and outputs together."""
        return float(np.nansum(self.mse * self.count) / self.count.sum())


def as_waves_are_written(
    model: Model, unknowns: Sequence[Unknown], values: np.ndarray, covariance: np.ndarray
) -> tuple[np.ndarray, np.ndarray]:
    """The same fit in the one form of a wave that all fits report (Effect.wave)."""
    values, sign = values.copy(), np.ones(len(values))
    place = {u.name: i for i, u in enumerate(unknowns)}
    for effect in model.effects:
        amplitude, phase = (place.get(f'{effect.label}.{n}') for n in effect.wave or ('', ''))
        if amplitude is None or phase is None:
            continue
        if values[amplitude] < 0:
            values[amplitude] *= -1
            values[phase] += np.pi
            sign[amplitude] = -1
        values[phase] = np.pi - (np.pi - values[phase]) % (2 * np.pi)
    return values, covariance * np.outer(sign, sign)


def with_uncertainty(
    model: Model, unknowns: tuple[Unknown, ...], values: np.ndarray, covariance: np.ndarray
) -> Model:
    """The model with identified values, and their standard deviations as tolerances."""
    model = model.with_values({u.name: v for u, v in zip(unknowns, values, strict=True)})
    quantities = dict(model.quantities)
    for j, (u, v) in enumerate(zip(unknowns, values, strict=True)):
        sigma = np.sqrt(max(covariance[j, j], 0.0)) * (abs(v) if u.logarithmic else 1.0)
        if np.isfinite(sigma):
            quantities[u.name] = replace(
                quantities[u.name], tolerance=float(sigma), source='identified'
            )
    return replace(model, quantities=quantities)


def warnings_of(fit: Fit, bounds: Collection[str]) -> Iterator[str]:
    """What a person should know of a fit; nothing of unknowns that `bounds` keep small.

    What lies at the edge of its range, what the records do not determine, what is far from the
    file's belief, and pairs that are told apart only poorly.
    """
    sigmas = fit.sigmas
    for u, value, sigma, share in zip(
        fit.unknowns, fit.values, sigmas, fit.information, strict=True
    ):
        if u.name in bounds:
            continue  # the bound is a statement, not a finding
        unit = '' if u.unit == '1' else f' {u.unit}'
        near = 1e-6 * min(u.upper - u.lower, u.scale)
        declared = fit.model.declarations[u.name]
        inside = {'lower': value - u.lower, 'upper': u.upper - value}
        at_edge = any(inside[end] <= near for end in inside.keys() - declared.ends)
        if at_edge and value != declared.neutral:
            yield f'{u.name} = {value:.4g}{unit} lies at the edge of its range'
        if not np.isfinite(sigma):
            yield f'{u.name} cannot be identified from these records'
        elif u.name in fit.undetermined:
            yield (
                f'{u.name} = {value:.2g} +- {sigma:.2g}{unit} is not determined by these '
                'records: what acts like this need not be what it is named after'
            )
        elif share < 0.2 and np.isfinite(u.tolerance):
            yield (
                f'{u.name} is hardly seen by these records: its value is mostly what the '
                'model file believed'
            )
        if np.isfinite(u.tolerance):
            away = abs(u.to_coordinate(value) - u.to_coordinate(u.prior)) / u.tolerance
            if away > 3:
                yield (
                    f'{u.name} = {value:.4g}{unit} is {away:.1f} tolerances away from what '
                    f'the model file believes ({u.prior:.4g})'
                )
    finite = np.isfinite(np.diag(fit.covariance))
    spread = np.sqrt(np.where(finite, np.diag(fit.covariance), 1))
    for a in range(len(spread)):
        for b in range(a):
            if finite[a] and finite[b] and spread[a] and spread[b]:
                r = fit.covariance[a, b] / (spread[a] * spread[b])
                if abs(r) > 0.98:
                    yield (
                        f'{fit.unknowns[b].name} and {fit.unknowns[a].name} are told apart only '
                        f'poorly: correlation {r:+.3f}'
                    )
