"""What a linear controller is designed on: balance.md, "The design model".

A controller acts on the four coordinates and rates of a stance phase, so its design model has no
others: a spring before a rotor, lags and delays are what the loop must tolerate. Dry friction has
no slope at standstill that means anything (tanh(v / 0.01 rad/s) would look like a viscous
friction of 184 N m s/rad); it is compensated or tolerated, not designed on. Derivatives are exact
(cg_dynamics.linearise, Eq. 4.8 and 4.9); the discrete form holds the torque over a sample:

    A_d = exp(A T),   B_d = int_0^T exp(A s) ds B,   c_d = int_0^T exp(A s) ds f(x0, u0)     (ZOH)
"""

from dataclasses import dataclass

import numpy as np
from scipy.linalg import expm

from cg_dynamics.linearise import (
    Linearisation,
    linearise,
    without_dry_friction,
    without_extra_states,
)
from cg_dynamics.model import Model
from cg_dynamics.rig import Setup
from cg_dynamics.rollout.compiled import compile_model

# They change what is commanded, read or met on the way, not how the bodies move.
NOT_DESIGNED_ON = ('command', 'sensor', 'timing')


def design_model(model: Model, elastic: bool = False) -> Model:
    """The model without extra states, delays, sensor errors, ripple and dry friction.

    Args:
        model: A compass gait.
        elastic: Keep the states of the transmission, for a regulator of rotor and joint.
    """
    model = without_extra_states(without_dry_friction(model), elastic)
    for effect in model.effects:
        if effect.ripple or effect.place in NOT_DESIGNED_ON:
            model = model.without_effect(effect.label)
    return model


def linearise_stance(
    model: Model,
    stance: str,
    x0: np.ndarray | None = None,
    u0: np.ndarray | None = None,
    elastic: bool = False,
) -> Linearisation:
    """The design model near a state, while one leg stands.

    Args:
        model: A compass gait; its design model is taken.
        stance: 'inner' or 'outer'.
        x0: State, shape (nx,), rad and rad/s: (q_inner, q_outer), rates, states of the
            transmission if elastic; None: upright at rest, which is an equilibrium.
        u0: Hip torque, shape (1,), N m; None: zero.
        elastic: Keep the states of the transmission.
    """
    design, setup = design_model(model, elastic), Setup(stance=stance)
    x0 = np.zeros(compile_model(design, setup).nx) if x0 is None else np.asarray(x0, float)
    u0 = np.zeros(1) if u0 is None else np.asarray(u0, float)
    return linearise(design, setup, x0, u0)


@dataclass(frozen=True)
class DiscreteLinearisation:
    """dx[k+1] = A dx[k] + B du[k] + c, for dx = x - x0, du = u - u0.

    Attributes:
        A: Shape (nx, nx).
        B: Shape (nx, nu).
        c: What x0 itself moves on by in a sample; zero at an equilibrium, shape (nx,).
        sample_time: In s.
    """

    A: np.ndarray
    B: np.ndarray
    c: np.ndarray
    sample_time: float


def discretise(linear: Linearisation, sample_time: float) -> DiscreteLinearisation:
    """(ZOH): exact for a torque held over the sample.

    Args:
        linear: Continuous linearisation.
        sample_time: T in s.
    """
    if not sample_time > 0:
        raise ValueError(f'sample_time is {sample_time}; it must be positive, in s')
    nx, nu = linear.B.shape
    block = np.zeros((nx + nu + 1,) * 2)
    block[:nx] = np.column_stack([linear.A, linear.B, linear.rates])
    held = expm(block * sample_time)[:nx]
    return DiscreteLinearisation(
        held[:, :nx], held[:, nx : nx + nu], held[:, nx + nu], sample_time
    )
