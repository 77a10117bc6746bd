"""The rigid-body mechanisms, by name."""

from cg_dynamics.errors import ModelError
from cg_dynamics.mechanisms.compass_gait import CompassGait
from cg_dynamics.mechanisms.double_pendulum import DoublePendulum
from cg_dynamics.mechanisms.mechanism import Mechanism
from cg_dynamics.mechanisms.pendulum import Pendulum

MECHANISMS: dict[str, Mechanism] = {
    mechanism.name: mechanism for mechanism in (CompassGait(), Pendulum(), DoublePendulum())
}

__all__ = ['MECHANISMS', 'CompassGait', 'DoublePendulum', 'Mechanism', 'Pendulum', 'mechanism']


def mechanism(name: str) -> Mechanism:
    """The mechanism called name.

    Raises:
        ModelError: listing the mechanisms there are.
    """
    try:
        return MECHANISMS[name]
    except KeyError:
        raise ModelError(
            f'unknown mechanism {name!r}; there are: {", ".join(MECHANISMS)}'
        ) from None
