"""The rigid-body mechanisms, by name. A new one is one class in one file of this folder.

Every module here that defines a subclass of `Mechanism` with a name is found by itself.
"""

import importlib
import pkgutil

from cg_dynamics.errors import ModelError
from cg_dynamics.mechanisms.mechanism import Mechanism

__all__ = ['MECHANISMS', 'Mechanism', 'mechanism']


def _library() -> dict[str, Mechanism]:
    found: dict[str, Mechanism] = {}
    for module in sorted(m.name for m in pkgutil.iter_modules(__path__)):
        contents = vars(importlib.import_module(f'{__name__}.{module}'))
        for item in contents.values():
            if isinstance(item, type) and issubclass(item, Mechanism) and 'name' in vars(item):
                found[item.name] = item()
    return found


MECHANISMS = _library()


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
