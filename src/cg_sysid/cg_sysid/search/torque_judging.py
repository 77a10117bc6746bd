"""What an effect gains by the torques of a robot, and whether that is worth it.

A structure is fitted by torques to some records and judged by others (diagnosis.md, section 4).
Numbers are told with standard deviations by the curvature of (T) and by belief.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from cg_dynamics.effects.effect import Effect
from cg_dynamics.model import Model
from cg_sysid.identification import torque_error
from cg_sysid.identification.data_set import DataSet
from cg_sysid.identification.information_criterion import block_gain, independent_samples
from cg_sysid.identification.student_t import (
    deviance_by_column,
    deviances,
    row_scale,
    scale_of,
)
from cg_sysid.identification.torque_error import Left, TorqueFit, all_rows
from cg_sysid.identification.unknowns import IdentificationError, unknowns_of
from cg_sysid.search import settings
from cg_sysid.search.model_selection import block_s
from cg_sysid.search.outcome import edges, edges_in_words
from cg_sysid.text import measured

MATERIAL = 0.1  # of the squared torque error of one joint, held out, that an effect takes at least
EVERY_JOINT = 'viscous_friction', 'coulomb_friction'  # has them
LOST = 1e-12  # of a curvature beside the steepest: nothing is known there

Sizes = Mapping[str, tuple[float, float, str]]


@dataclass(frozen=True)
class Law:
    """An effect that the torques lack.

    Attributes:
        label: Its label.
        nats: Evidence of the records fitted to.
        significance: Standard errors by which the torque error of records held out falls.
        taken: Share of the squared torque error of each coordinate that it takes, shape (n,).
        parameters: Name -> value, standard deviation, unit, by all records.
        relieves: Whether it takes the place of numbers that nobody believes.
        rivals: Labels of others that these torques cannot tell from it.
        reason: Why it is not taken up; empty if it is worth it.
    """

    label: str
    nats: float
    significance: float
    taken: np.ndarray
    parameters: Sizes
    relieves: bool = False
    rivals: tuple[str, ...] = ()
    reason: str = ''


@dataclass(frozen=True)
class Fitted:
    """A structure, what the torques of some records say of it, and what it leaves in all.

    Attributes:
        model: With the numbers of the file.
        said: The torque fit.
        train: Of the torques of each record fitted to.
        held: The same of those held out.
    """

    model: Model
    said: TorqueFit
    train: list[Left]
    held: list[Left]

    @property
    def standing(self) -> Model:
        """The model with the numbers that the torques say."""
        return self.model.with_values(self.said.values)

    def independent(self) -> tuple[np.ndarray, np.ndarray]:
        """Independent ones among the torques of the records fitted to: number and share, (n,)."""
        weighted = [one.error / row_scale(one.error, self.said.scale) for one in self.train]
        steps = [one.stride for one in self.train]
        number = np.array([
            independent_samples([rows[:, [k]] for rows in weighted], steps)
            for k in range(len(self.said.scale))
        ])  # fmt: skip
        count = np.isfinite(np.vstack(weighted)).sum(axis=0)
        return number, number / np.maximum(count, number)

    @property
    def deviance(self) -> np.ndarray:
        """(T) of the records fitted to, of each coordinate, (n,)."""
        return deviance_by_column(all_rows(self.train))

    @property
    def disbelief(self) -> float:
        """Squared distance of the numbers from what the file believes, in its tolerances."""
        return self.said.deviance - float(self.deviance.sum())


@dataclass(frozen=True)
class Gain:
    """What numbers more gain (diagnosis.md, section 4).

    Attributes:
        nats: Evidence of the records fitted to.
        significance: Standard errors by which the torque error of records held out falls.
        taken: Share of the squared torque error of each coordinate that they take, shape (n,).
        relieved: Part of the evidence, in nats, that is belief in other numbers.
    """

    nats: float
    significance: float
    taken: np.ndarray
    relieved: float

    @property
    def relieves(self) -> bool:
        """Whether they take the place of numbers that nobody believes: these lower no error.

        As a payload that of a link too heavy.
        """
        return self.relieved > settings.SELECTION.earned

    @property
    def significant(self) -> bool:
        """Whether records held out gain.

        By what only takes the place of numbers that nobody believes they gain nothing: they must
        not lose.
        """
        needed = settings.SELECTION.significant
        return self.significance >= (-needed if self.relieves else needed)


@dataclass(frozen=True)
class Judge:
    """Fits and judgements on one split of the records."""

    train: Sequence[DataSet]
    held: Sequence[DataSet]

    def fit(self, model: Model, at: Mapping[str, float]) -> Fitted:
        """A structure fitted by torques, from given values."""
        said = torque_error.fit_by_torque(model, self.train, at=at)
        if said is None:
            raise IdentificationError(
                'no torques can be compared: the recordings are shorter than a quarter of a '
                'second, or positions are missing in all of them'
            )
        return self.with_errors(model, said)

    def with_errors(self, model: Model, said: TorqueFit) -> Fitted:
        """A torque fit of the records fitted to, and what it leaves in all."""
        standing = model.with_values(said.values)
        train, held = (
            torque_error.left_by(standing, records) for records in (self.train, self.held)
        )
        if not held:
            raise IdentificationError(
                'no torques to judge by: the recordings held out are shorter than a quarter of a '
                'second, or positions are missing in all of them'
            )
        return Fitted(model, said, train, held)

    def law(
        self,
        without: Fitted,
        with_it: Fitted,
        label: str,
        independent: tuple[np.ndarray, np.ndarray],
    ) -> Law:
        """What an effect gains, and whether that is worth it (diagnosis.md, section 4).

        Args:
            without: Fitted without it.
            with_it: Fitted with it.
            label: Its label.
            independent: Number and share of independent torques, of who leads (independent()).
        """
        effect, known = with_it.model.effect(label), self.sizes(with_it, label)
        gain = self.gain(without, with_it, len(known), independent)
        how_much = {size.name: known[size.name] for size in effect.sizes if size.name in known}
        reasons = _shortcomings(gain, how_much, at_every_joint(effect))
        reasons += edges_in_words(label, self._at_edge(with_it, label))
        return Law(label, gain.nats, gain.significance, gain.taken, known, gain.relieves,
                   reason='; '.join(reasons))  # fmt: skip

    def gain(
        self,
        without: Fitted,
        with_it: Fitted,
        count: int,
        independent: tuple[np.ndarray, np.ndarray],
    ) -> Gain:
        """What so many numbers more gain."""
        number, share = independent
        gained = share @ (without.deviance - with_it.deviance) / 2
        relieved = (without.disbelief - with_it.disbelief) / 2
        nats = gained + relieved - count / 2 * np.log(number.sum())
        # Rows in which friction turns are far off with any law: they count as (T) has it.
        before, after = (
            [np.sqrt(deviances(one.error, without.said.scale)) for one in fitted.held]
            for fitted in (without, with_it)
        )
        stride = float(np.median([one.stride for one in without.held]))
        significance = block_gain(before, after, round(block_s(self.held) / stride))
        left, was = (scale_of(all_rows(fitted.held)) for fitted in (with_it, without))
        return Gain(float(nats), significance, 1 - (left / was) ** 2, float(relieved))

    def _at_edge(self, fitted: Fitted, label: str) -> dict[str, tuple[float, str]]:
        known = fitted.said.values
        numbers = [(u, known[u.name]) for u in unknowns_of(fitted.model) if u.name in known]
        return edges(label, fitted.model.effect(label).parameters, numbers)

    def sizes(self, fitted: Fitted, label: str) -> Sizes:
        """An effect's numbers, with standard deviations by the curvature of (T) and by belief."""
        values, own = fitted.said.values, f'{label}.'
        unknowns = tuple(u for u in unknowns_of(fitted.model) if u.name in values)
        problems = torque_error.problems_of(fitted.model, self.train, unknowns)
        theta = np.array([u.to_coordinate(values[u.name]) for u in unknowns])
        scale = np.nan_to_num(row_scale(all_rows(fitted.train), fitted.said.scale), nan=1.0)
        _, share = fitted.independent()
        j = torque_error.derivatives(problems, unknowns, theta) / scale[:, :, None]
        j = (np.sqrt(share)[:, None] * j).reshape(-1, len(unknowns))
        curvature = j.T @ j + np.diag([1 / u.tolerance**2 for u in unknowns])
        seen = np.diag(curvature) > 0
        steep = np.sqrt(np.diag(curvature)[seen])
        scaled = curvature[np.ix_(seen, seen)] / np.outer(steep, steep)
        sigmas = np.full(len(unknowns), np.inf)
        sigmas[seen] = np.sqrt(np.diag(np.linalg.inv(scaled + LOST * np.eye(len(steep))))) / steep
        return {
            u.name.removeprefix(own): (
                values[u.name], float(sigma) * (values[u.name] if u.logarithmic else 1.0), u.unit
            )
            for u, sigma in zip(unknowns, sigmas, strict=True) if u.name.startswith(own)
        }  # fmt: skip


def at_every_joint(effect: Effect) -> bool:
    """Whether every joint has some of it, so that a little is no surprise."""
    return effect.name in EVERY_JOINT


def _shortcomings(gain: Gain, sizes: Sizes, expected: bool) -> list[str]:
    """Why what an effect gains is not worth it."""
    found = []
    if gain.nats < settings.SELECTION.earned:
        found.append(f'evidence {gain.nats:.1f} nats, {settings.SELECTION.earned:g} needed')
    if not gain.significant:
        found.append('no significant gain on recordings held out')
    if np.nanmax(gain.taken) < MATERIAL and not (gain.relieves or expected):
        found.append(f'takes less than {MATERIAL:.0%} of the squared error of any joint')
    small = settings.SELECTION.too_small
    if sizes and all(abs(size) < small * sigma for size, sigma, _ in sizes.values()):
        said = [f'{name} = {measured(*size)}' for name, size in sizes.items()]
        found.append(f'{" and ".join(said)} may be none')
    return found
