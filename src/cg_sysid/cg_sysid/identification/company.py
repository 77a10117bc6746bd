"""Effects in company: one compiled model for all that act at one place.

To compile a model takes longer than a first look with it, and a search looks at dozens of effects
on top of one base. So the last effect of a model is compiled beside the others of its place, which
are at rest: there their laws vanish, and the simulation is the same. For the next of them the
model is there at once. It takes up to two and a half times as long to run. That pays for looks
at a few seconds, not for fits to whole records.
"""

from cg_dynamics.effects import LIBRARY
from cg_dynamics.effects.effect import Effect
from cg_dynamics.model import Model
from cg_dynamics.parameter import Parameter
from cg_dynamics.rollout.accuracy import REFERENCE_STEP

# Places whose effects go together: the equations of each change alike.
PLACES = ('sensor',), ('timing',), ('command', 'transmission', 'joint'), ('environment', 'body')


def in_company(model: Model) -> tuple[Model, Model]:
    """A model beside the effects that keep its last one company.

    Args:
        model: A mechanism in the plane; a robot of a URDF has too many joints and is left alone.

    Returns:
        The model to compile, in which all of them act, and the same with the others at rest.
    """
    if not model.effects or model.mechanism.dimensions != 2:
        return model, model
    *base, last = model.effects
    # As the library has it: whether its size is one for all recordings changes no equation.
    if last.name not in LIBRARY or not _goes_along(LIBRARY[last.name](model.mechanism, last.at)):
        return model, model
    (places,) = (places for places in PLACES if last.place in places)
    present = {effect.label for effect in base}
    together = [e for e in _library_of(model, places) if e.label not in present]
    # One order, whichever of them was the last: the compiled model is the same for all.
    resting = model.without_effect(last.label)
    for effect in together:
        resting = resting.with_effect(effect.name, effect.at, **{_size(effect).name: 0.0})
    resting = resting.with_values(
        {f'{last.label}.{p.name}': model.values[f'{last.label}.{p.name}'] for p in last.parameters}
    )
    return resting.with_values(dict(map(_a_little, together))), resting


def _library_of(model: Model, places: tuple[str, ...]) -> list[Effect]:
    """Effects at these places of a mechanism that go along with others."""
    found = [
        kind(model.mechanism, at)
        for kind in LIBRARY.values()
        if kind.place in places
        for at in kind.sites(model.mechanism)
    ]
    return [effect for effect in found if _goes_along(effect)]


def _goes_along(effect: Effect) -> bool:
    """Whether it can be at rest without a trace: no states, inputs or steps of its own."""
    return (
        any(effect.place in places for places in PLACES)
        and not effect.states
        and not effect.extra_inputs
        and effect.largest_step >= REFERENCE_STEP
        and _size(effect).neutral == 0.0
        # Steps of no height, and waves that are sought by their frequency.
        and not any(p.each or p.swept for p in effect.parameters)
    )


def _size(effect: Effect) -> Parameter:
    """The parameter without which the effect is none."""
    return effect.parameters[0]


def _a_little(effect: Effect) -> tuple[str, float]:
    """Full name of its size, and a value at which it acts."""
    size = _size(effect)
    return f'{effect.label}.{size.name}', size.starts[0] if size.starts else size.scale
