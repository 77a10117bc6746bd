"""What no effect of the library explains, as one learned term, and in words.

How it is found is in characterise.py.
"""

from dataclasses import dataclass, field

from cg_dynamics.effects.effect import TIME
from cg_dynamics.effects.unmodelled import UNITS, JointTerm, LearnedEffect, OuterTerm, SensorTerm
from cg_sysid.identification.fit_result import Fit
from cg_sysid.learned.shape import Shape
from cg_sysid.text import listed, number, scaled, sentence

NOTHING = (
    'No torque, friction, gain or sensor error that is a function of one variable explains it.'
)
BY_CARRIER = {
    'torque': 'a torque at the {}',
    'friction': 'dry friction at the {}',
    'damping': 'viscous friction at the {}',
    'gain': 'a torque in proportion to that of the motor at the {}, with a factor',
}


@dataclass(frozen=True)
class Unmodelled:
    """What is left, as one learned term.

    Attributes:
        effect: The term.
        shape: Its function; where every record has its own phase, that of the strongest.
        period: Period and its standard deviation, in the unit of the variable; None if it does not
            repeat.
        amplitudes: Record -> amplitude of the first wave, where every record has its own phase.
        evidence: In nats against the model without it.
        significance: Of the fall of the held-out error, in standard errors.
        explained: Share of the squared error above the noise that it removes on records held out:
            whole ones, or windows of them where `held` is None.
        window: Length in s of the windows on which terms were compared; None for whole records.
        rivals: Other terms that explain the records as well.
        fit: The model with the term in it, identified.
        held: Score of that model on held-out records; None if only windows could be fitted.
        nearest: Effects of the library that were taken for it until this term was tried.
    """

    effect: LearnedEffect
    shape: Shape
    period: tuple[float, float] | None
    amplitudes: dict[str, float]
    evidence: float
    significance: float
    explained: float
    window: float | None
    rivals: tuple[LearnedEffect, ...]
    fit: Fit = field(repr=False)
    held: Fit | None = field(repr=False)
    nearest: tuple[str, ...] = ()

    @property
    def label(self) -> str:
        """Label of the term."""
        return self.effect.label

    @property
    def variable_unit(self) -> str:
        """Unit of what the function follows."""
        return UNITS[self.effect.variable]

    @property
    def where(self) -> str:
        """`joint`, `torque path`, `outside` or `sensor`."""
        return where_of(self.effect)

    @property
    def what(self) -> str:
        """What acts where and what it follows, if it varies at all."""
        if not self.shape.constant:
            return term_words(self.effect)
        size = _quantity(self.shape.mean, self.effect.unit)
        return f'{_carried(self.effect)} that is constant, {size}'

    @property
    def text(self) -> str:
        """One sentence for people, and one on rivals."""
        features = '' if self.shape.constant else f': {", ".join(self._features())}'
        said = (
            f'{sentence(self.what)}{features}. It explains '
            f'{100 * self.explained:.3g} % of the error above the noise on records held out.'
        )
        if self.rivals:
            others = listed([term_words(rival) for rival in self.rivals], 'or')
            said += f' These records do not tell it from {others}.'
        if self.nearest:
            said += f' Of the library, {listed(list(self.nearest))} came nearest.'
        return said

    def _features(self) -> list[str]:
        shape = self.shape
        found = [shape.parity] if shape.parity else []
        if self.period is not None:
            found.append(f'repeating every {_quantity(self.period[0], self.variable_unit)}')
        if self.period is not None and self.variable_unit == 's':
            found[-1] += f' ({number(1 / self.period[0])} Hz)'
        if self.amplitudes:
            found.append("with a phase of each record's own")
        if shape.stretch is not None:
            factor, unit = scaled(max(map(abs, shape.stretch)), self.variable_unit)
            low, high = (number(factor * end, 2) for end in shape.stretch)
            where = f'from {low} to {high}' if low != high else f'near {low}'
            found.append(f'mostly {where} {unit}')
        peak = f' and {_quantity(shape.peak, self.effect.unit)} at most'
        if shape.peak < shape.rms:
            where = 'where it is largest' if shape.peak else 'anywhere'
            peak = f', its size not sure {where}'
        return [*found, f'{_quantity(shape.rms, self.effect.unit)} RMS{peak}']


def _quantity(value: float, unit: str) -> str:
    factor, unit = scaled(value, unit)
    return f'{number(factor * value, 2)} {unit}'.strip()


def where_of(effect: LearnedEffect) -> str:
    """`joint`, `torque path`, `outside` or `sensor`."""
    if isinstance(effect, SensorTerm):
        return 'sensor'
    if isinstance(effect, OuterTerm):
        return 'outside'
    on_the_way = effect.variable == 'torque' or 'gain' in effect.name
    return 'torque path' if on_the_way else 'joint'


def term_words(effect: LearnedEffect) -> str:
    """What acts where and what it follows: `a torque at the hip that follows the hip angle`."""
    return f'{_carried(effect)} that follows {variable_words(effect)}'


def _carried(effect: LearnedEffect) -> str:
    """What acts where: `a torque at the hip`."""
    place = effect.site.partition(':')[0]
    if isinstance(effect, JointTerm):
        return BY_CARRIER[effect.carrier].format(place)
    if isinstance(effect, OuterTerm):
        leg = 'the leg that stands' if place == 'stance' else f'the {place} legs'
        return f'a torque from outside on {leg}'
    return f'an error of {place}'


def variable_words(effect: LearnedEffect) -> str:
    """What the function follows: `the hip angle`, `its own reading`, `the time`."""
    if effect.follows == TIME:
        return 'the time of the record'
    kind, _, of = effect.follows.partition(':')
    if isinstance(effect, SensorTerm):
        own = of == effect.site
        if own and (kind == 'angle') != effect.unit.endswith('/s'):
            return 'its own reading'
        return 'the rate of its reading' if own else of.replace('_', ' ')
    if kind == 'torque':
        return 'the torque of the motor'
    if of.startswith('q_'):
        return f'the {kind} of the {of.removeprefix("q_")} legs'
    if isinstance(effect, OuterTerm):
        return f'its {kind}'
    return f'the {of.removesuffix("_angle")} {kind}'
