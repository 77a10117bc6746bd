"""The rigid-body mechanisms, by name. A new one is one class in one file of this folder.

Every module here that defines a subclass of `Mechanism` with a name is found by itself.
"""

import importlib
import pkgutil
from collections.abc import Mapping
from typing import Any

from cg_description.reading import shown
from cg_description.robot_description import RobotDescriptionError, parse
from cg_dynamics.errors import ModelError
from cg_dynamics.mechanisms.mechanism import Mechanism
from cg_dynamics.mechanisms.urdf import Urdf

__all__ = ['MECHANISMS', 'Mechanism', 'mechanism']


def _library() -> dict[str, Mechanism]:
    found: dict[str, Mechanism] = {}
    for module in sorted(m.name for m in pkgutil.iter_modules(__path__)):
        contents = vars(importlib.import_module(f'{__name__}.{module}'))
        for item in contents.values():
            if isinstance(item, type) and issubclass(item, Mechanism) and 'name' in vars(item):
                found[item.name] = item()
    return found


URDF = 'urdf'  # the mechanism that is whatever its file says; it has no entry of its own below
MECHANISMS = _library()


def mechanism(name: str, robot: Mapping[str, Any] | None = None) -> Mechanism:
    """The mechanism called name.

    Args:
        name: One of `MECHANISMS`, or 'urdf'.
        robot: The robot of a URDF (model_file.ROBOT).

    Raises:
        ModelError: listing the mechanisms there are, or saying what is wrong with the robot.
    """
    if (name == URDF) is (robot is None):
        raise ModelError(
            f"mechanism {name!r} needs an entry 'robot' with its URDF; `cg new-robot` writes one"
            if robot is None
            else f"'robot' belongs to the mechanism {URDF}, not to {name!r}"
        )
    if robot is not None:
        try:
            description = parse(robot['urdf'], 'robot.urdf')
        except RobotDescriptionError as error:
            raise ModelError(str(error)) from None
        return Urdf(
            description, robot.get('driven'), bool(robot.get('rates')), robot.get('couplings')
        )
    try:
        return MECHANISMS[name]
    except KeyError:
        raise ModelError(
            f'unknown mechanism {shown(name)}; there are: {", ".join((*MECHANISMS, URDF))}'
        ) from None
