"""What a physical parameter is: the one place of its name, unit, range and neutral value."""

import math
from dataclasses import dataclass, replace

from cg_dynamics.errors import ModelError

# Along a joint that slides an angle becomes a length: a torque a force, an inertia a mass.
SLIDING = {'N m': 'N', 'kg m^2': 'kg', 'rad': 'm'}


def sliding_unit(unit: str) -> str:
    """What a unit of a joint that turns becomes along one that slides: N m s/rad is N s/m."""
    for turning, sliding in SLIDING.items():
        unit = unit.replace(turning, sliding)
    return unit


@dataclass(frozen=True)
class Parameter:
    """Declaration of a parameter of a mechanism or an effect.

    Attributes:
        name: Name within its owner, e.g. 'stiffness'.
        unit: SI unit, '1' for a ratio; of an effect, where it acts on a joint that turns.
        description: One phrase for people.
        lower: Smallest allowed value, in `unit`.
        upper: Largest allowed value, in `unit`.
        neutral: Value at which the effect vanishes exactly; None where no single value does that
            (a parameter of shape).
        starts: Values from which an identification sets out when nothing is known yet.
        free: False for a parameter of shape that identification leaves alone unless told, or for
            a choice between its starts.
        scale: Typical size of a change worth noticing, in `unit`; steps and priors use it.
        logarithmic: True where the ratio of two values means more than their difference.
        swept: True for a frequency or an instant, where the error has many local minima: a first
            look keeps it at each of its starts.
        each: What has a value of its own, 'record' (as the instant of a push) or 'recording', all
            pieces of one together; the value in a model stands for those that nobody has seen.
            Empty for a property of the machine.
        leeway: Of a parameter of shape, a device of the model: how far from its value the law of
            a real machine may lie, in `unit`, or as a logarithm where it is logarithmic.
        along: Unit on a joint that slides where that is not `sliding_unit(unit)`: a phase stays
            one.
        smoothing: True for a rate over which a law of dry friction turns its sign. Machines turn
            it faster; a solver may start with a wider one.
        ends: The ends of its range, 'lower', 'upper' or both, at which physics ends as well: a
            share that is none or all, a pulse too short for its shape to matter. A value there is
            a finding as any other.
        belief: True where a model that does not state a value believes the neutral one, with
            `scale` as standard deviation.
    """

    name: str
    unit: str
    description: str
    lower: float
    upper: float
    neutral: float | None = None
    starts: tuple[float, ...] = ()
    free: bool = True
    scale: float = 1.0
    logarithmic: bool = False
    swept: bool = False
    each: str = ''
    leeway: float = 0.0
    along: str = ''
    smoothing: bool = False
    ends: tuple[str, ...] = ()
    belief: bool = False

    def sliding(self) -> 'Parameter':
        """This declaration for a joint that slides."""
        return replace(self, unit=self.along or sliding_unit(self.unit))

    def of_size(self, inertia: float) -> 'Parameter':
        """This declaration where a drive has to turn so many kg m^2 (kg), and not one.

        At the same accelerations and frequencies, torques, stiffness and inertias follow it. The
        range becomes wider only.
        """
        if not self.follows_size:
            return self
        return replace(
            self.reaching(inertia),
            starts=tuple(inertia * x for x in self.starts),
            scale=inertia * self.scale,
        )

    def reaching(self, inertia: float) -> 'Parameter':
        """This declaration with a range for drives that have to turn so many kg m^2 (kg) too."""
        if not self.follows_size:
            return self
        return replace(
            self,
            lower=min(self.lower, inertia * self.lower),
            upper=max(self.upper, inertia * self.upper),
        )

    @property
    def follows_size(self) -> bool:
        """Whether it is a torque, a stiffness, a damping or an inertia."""
        return self.unit.startswith(('N', 'kg'))

    @property
    def default(self) -> float:
        """Value used when a file names the effect but not this parameter."""
        if self.starts:
            return self.starts[0]
        if self.neutral is not None:
            return self.neutral
        raise ModelError(f'{self.name!r} has no default; state it')

    @property
    def choice(self) -> bool:
        """Whether an identification tries each of the starts and stays where it set out."""
        return not self.free and self.neutral is None and len(self.starts) > 1

    def check(self, value: float, owner: str) -> float:
        """Return value if it is allowed.

        Raises:
            ModelError: naming the parameter, the value and the range.
        """
        if value == self.neutral:
            return value
        if not math.isfinite(value) or not self.lower <= value <= self.upper:
            raise ModelError(
                f'{owner}.{self.name} = {value:g} {self.unit} is outside its range '
                f'[{self.lower:g}, {self.upper:g}] {self.unit}'
            )
        return value
