"""Linearisation of an assembled model at any state: Eq. 4.8 and 4.9, theory.md, (LIN).

    dx/dt = f(x0, u0) + A (x - x0) + B (u - u0),   y = h(x0, u0) + C (x - x0) + D (u - u0)

A and B are derivatives of the whole right-hand side, so they hold away from equilibria too, where
the form printed as Eq. 4.8 (which drops the derivatives of H^-1 and C) does not.
"""

import functools
from collections.abc import Mapping
from dataclasses import dataclass

import casadi as ca
import numpy as np

from cg_dynamics.assemble import parameter_vector
from cg_dynamics.effects import make_effect
from cg_dynamics.model import Model
from cg_dynamics.rig import Setup
from cg_dynamics.rollout.compiled import CompiledModel, compile_model


@dataclass(frozen=True)
class Linearisation:
    """A model near (x0, u0).

    Attributes:
        A: df/dx in 1/s and the units of x, shape (nx, nx).
        B: df/du, shape (nx, nu).
        C: dh/dx, shape (ny, nx).
        D: dh/du, shape (ny, nu).
        rates: f(x0, u0), zero at an equilibrium, shape (nx,).
        outputs: h(x0, u0), shape (ny,).
        state_names: Names of x.
    """

    A: np.ndarray
    B: np.ndarray
    C: np.ndarray
    D: np.ndarray
    rates: np.ndarray
    outputs: np.ndarray
    state_names: tuple[str, ...]


@functools.cache
def jacobians(compiled: CompiledModel) -> ca.Function:
    """x, u, p -> A, B, C, D, rates, outputs. `Function.map` makes it one call per trajectory."""
    e = compiled.equations
    expressions = [
        *e.rates_by(e.x, e.u),
        ca.jacobian(e.outputs, e.x),
        ca.jacobian(e.outputs, e.u),
        e.rates,
        e.outputs,
    ]
    names = ['A', 'B', 'C', 'D', 'rates', 'outputs']
    dense = list(ca.cse([ca.densify(expression) for expression in expressions]))
    return ca.Function('jacobians', [e.x, e.u, e.p], dense, ['x', 'u', 'p'], names)


def linearise(model: Model, setup: Setup, x0: np.ndarray, u0: np.ndarray) -> Linearisation:
    """(LIN) of a model in a set-up. Delays are left out: they are not part of f.

    Args:
        model: The model.
        setup: The set-up.
        x0: State, shape (nx,).
        u0: Inputs, shape (nu,), N m.
    """
    compiled = compile_model(model, setup)
    results = jacobians(compiled)(x0, u0, parameter_vector(model, setup))
    A, B, C, D, rates, outputs = (np.asarray(result) for result in results)
    return Linearisation(A, B, C, D, rates.ravel(), outputs.ravel(), compiled.state_names)


def without_dry_friction(model: Model) -> Model:
    """What a linear design may be made on: tanh(v / 0.01 rad/s) is no viscous friction."""
    for effect in model.effects:
        if effect.friction == 'dry':
            model = model.without_effect(effect.label)
    return model


def without_extra_states(model: Model, elastic: bool = False) -> Model:
    """The model with the states of its coordinates alone; a rotor turns with the joint then.

    Args:
        model: Any model.
        elastic: Keep the states of the transmission.
    """
    for effect in model.effects:
        if (effect.states or effect.extra_inputs) and not (elastic and effect.elastic):
            left = effect.without_states(model.values_of(effect))
            model = model.without_effect(effect.label)
            for name, values in left.items():
                model = _with_more(model, name, effect.site, values)
    return model


def _with_more(model: Model, name: str, site: str, values: Mapping[str, float]) -> Model:
    """The model with an effect, or with more of it where it is there: what it scales with adds."""
    effect = make_effect(name, model.mechanism, site)
    if all(effect.label != other.label for other in model.effects):
        return model.with_effect(name, site, **values)
    first = effect.parameters[0].name
    total = model.values[f'{effect.label}.{first}'] + values[first]
    return model.with_values({f'{effect.label}.{first}': total})
