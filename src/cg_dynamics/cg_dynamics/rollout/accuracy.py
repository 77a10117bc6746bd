"""How finely a record is integrated: one value on its way from a fit to the C code."""

from typing import NamedTuple

REFERENCE_STEP = 0.002  # s
TOLERANCE = 3e-7  # error of a step in units of the state scales; play multiplies it
HALVINGS = 5  # of a step, one after the other
COARSE_HALVINGS = 3  # of a step of a coarse simulation: stiffer than real drives are no drives


class Accuracy(NamedTuple):
    """Steps of an integration.

    Attributes:
        longest: Step in s, where nothing asks for shorter ones.
        tolerance: Error of a step, in units of the states' scales, from which it is halved.
        halvings: How often it is, at most.
    """

    longest: float
    tolerance: float
    halvings: int

    @classmethod
    def of(cls, refinement: float) -> 'Accuracy':
        """With so many steps in place of one.

        What takes shorter steps than a coarse simulation may take runs away in it.
        """
        return cls(
            REFERENCE_STEP / refinement,
            TOLERANCE / refinement**4,
            HALVINGS if refinement >= 1 else COARSE_HALVINGS,
        )
