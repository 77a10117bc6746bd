"""What every real robot has a little of, and no diagnosis should cry about.

A delay of half a sample, an encoder zeroed to the width of a line, springs stiff to a per cent:
such small faults leave a simulation error many times the noise, and taken for the absence of
physics they would have any cause that happens to look like them. So they may explain an error
first, each within the bounds of a sound robot. What goes beyond is for a cause to explain.

So may the shape of a law (`Parameter.leeway`): how dry friction turns and fades, how a motor
saturates. Texts and machines differ in it, and it is no cause of its own.
"""

from collections.abc import Mapping, Sequence

from cg_dynamics.effects import LIBRARY
from cg_dynamics.effects.coulomb_friction import TRANSITION_RATE
from cg_dynamics.model import Model
from cg_dynamics.rig import Setup
from cg_sysid.text import measured

# Effect -> parameter and its largest size in a sound robot, in the unit of the parameter.
SOUND = {
    'actuator_delay': ('delay', 1.2e-3),
    'encoder_offset': ('offset', 6e-4),
    'imu_offset': ('offset', 2e-3),
    'spring_stiffness': ('error', 0.015),
}
# The same of laws that are too dear to be let go in every fit: dry friction of all machines gives
# way a little before it slides.
SOUND_LAWS = {'presliding_friction': ('deflection', 2.5e-3)}
# Other names of the same fault: in what is recorded, a late reading is a late torque.
LATE_READING = 'sensor_delay'
ALSO = {LATE_READING: 'actuator_delay'}
NEXT_TO_NOTHING = 1e-3  # of the largest size: at its neutral value an effect takes no part

Bounds = Mapping[str, float]


def with_nuisances(model: Model, setups: Sequence[Setup]) -> tuple[Model, Bounds]:
    """The model with the small faults that it does not state, and how large each may be.

    Returns:
        The model, and full name of a parameter -> largest distance from its value there, in the
        coordinate in which it is identified.
    """
    present = {effect.label for effect in model.effects}
    bounds = {}
    for effect in model.effects:
        for declared in effect.parameters:
            if declared.leeway:
                bounds[f'{effect.label}.{declared.name}'] = declared.leeway
    # What is late before steps has no slope by its delay, and no fit finds it.
    late = LATE_READING if any(effect.steps for effect in model.effects) else ALSO[LATE_READING]
    for fault, (parameter, largest) in SOUND.items():
        name = late if fault == ALSO[LATE_READING] else fault
        kind = LIBRARY[name]
        if not kind.applies(setups):
            continue
        for site in ('all',) if name == late else kind.sites(model.mechanism):
            label = kind(model.mechanism, site).label
            if label not in present:
                model = model.with_effect(name, site, **{parameter: NEXT_TO_NOTHING * largest})
                bounds[f'{label}.{parameter}'] = largest
    return model, bounds


def as_sound_robots(label: str, sizes: Mapping[str, tuple[float, float, str]]) -> list[str]:
    """Why an effect is no larger than sound robots have it; nothing if it is.

    Args:
        label: Of the effect.
        sizes: Its parameters: name -> (value, standard deviation, unit).
    """
    name = label.partition('@')[0]
    parameter, largest = (SOUND | SOUND_LAWS).get(ALSO.get(name, name), ('', 0.0))
    if parameter not in sizes or abs(sizes[parameter][0]) > largest:
        return []
    value, sigma, unit = sizes[parameter]
    return [
        f'{parameter} = {measured(value, sigma, unit)} is no more than sound robots have '
        f'({measured(largest, None, unit)})'
    ]


def turning(model: Model, name: str, at: str | None) -> dict[str, float]:
    """The smoothing of an effect of dry friction: that of the model's own at the same joint."""
    added = LIBRARY[name](model.mechanism, at)
    if all(p.name != TRANSITION_RATE.name for p in added.parameters):
        return {}
    at_joint = [f'{e.label}.{TRANSITION_RATE.name}' for e in model.effects if e.at == added.at]
    own = [model.values[name] for name in at_joint if name in model.values]
    return {TRANSITION_RATE.name: own[0]} if own else {}


def faults_among(model: Model, bounds: Bounds) -> Bounds:
    """Those bounds that are of small faults, and not of the shape of a law."""
    declared = model.declarations
    return {n: b for n, b in bounds.items() if n in declared and not declared[n].leeway}


def nuisances(model: Model, bounds: Bounds) -> set[str]:
    """Labels of the effects of a model that are small faults."""
    return {name.rpartition('.')[0] for name in faults_among(model, bounds)}
