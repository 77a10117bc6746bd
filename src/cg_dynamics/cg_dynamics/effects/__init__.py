"""The effect library, by standard name. A new effect is one class in one file of this folder.

Every module here that defines a subclass of `Effect` with a name is found by itself; learned terms
(unmodelled.py) have a registry of their own.
"""

import importlib
import pkgutil

from cg_description.reading import shown
from cg_description.schema import meant
from cg_dynamics.effects.effect import Body, Effect
from cg_dynamics.effects.unmodelled import UNMODELLED
from cg_dynamics.errors import ModelError
from cg_dynamics.mechanisms.mechanism import Mechanism

__all__ = ['LIBRARY', 'UNMODELLED', 'Body', 'Effect', 'make_effect']


def _library() -> dict[str, type[Effect]]:
    found: dict[str, type[Effect]] = {}
    for module in sorted(m.name for m in pkgutil.iter_modules(__path__)):
        contents = vars(importlib.import_module(f'{__name__}.{module}'))
        for item in contents.values():
            if isinstance(item, type) and issubclass(item, Effect) and 'name' in vars(item):
                found[item.name] = item
    for name in UNMODELLED:
        del found[name]
    return found


LIBRARY = _library()


def make_effect(name: str, mechanism: Mechanism, at: str | None = None) -> Effect:
    """The effect called name, acting at a joint, body or sensor of a mechanism.

    Raises:
        ModelError: if there is no such effect, or not at such a place.
    """
    known = LIBRARY.get(name) or UNMODELLED.get(name)
    if known is None:
        nearest = meant(name, LIBRARY) or f'; the library has: {", ".join(LIBRARY)}'
        raise ModelError(f'unknown effect {shown(name)}{nearest}')
    return known(mechanism, at)
