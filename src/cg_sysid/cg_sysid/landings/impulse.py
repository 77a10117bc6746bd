"""The impulse of the ground on a landing foot, from the jump of the rates alone.

Angles do not jump, so with G = M4^-1 A' of the unpinned model (contact.py)

    P = G_q^-1 (v+ - v-)                                                          (PLATE)

G_q its rows of the leg angles: two measured rates, two components of P, and nothing assumed about
the landing. v- comes from the motion before, v+ from parabolas through the first samples after:
what a foot does in these milliseconds, a bounce and the next touch, is counted in.
"""

import numpy as np

from cg_dynamics.effects.effect import ContactLaw
from cg_dynamics.model import Model
from cg_dynamics.walking.contact import Ground, contact_impulse, foot_functions, parameters
from cg_dynamics.walking.hybrid import WalkOptions, walk
from cg_sysid.landings.landings import STEP_S, Passage
from cg_sysid.landings.result import Impulse

AFTER_S = 0.02  # s after the touchdown that the parabolas see
FEWEST_IN_PARABOLA = 6  # samples


def measure_impulse(
    model: Model, passage: Passage, law: ContactLaw, own: np.ndarray, sigma: np.ndarray
) -> Impulse | None:
    """The impulse of one landing; None where there are too few samples.

    Args:
        model: The model.
        passage: The landing.
        law: The best law that is known; it only places the touchdown in time.
        own: What the landing has of its own, as fitted, shape (5,).
        sigma: Noise floor of each output, shape (ny,).
    """
    x0, duration = passage.start.copy(), float(passage.time[-1])
    x0[:4] = own[:4]
    options = WalkOptions(
        slope=float(own[4]), step=STEP_S, sample_time=duration, fall_angle=np.pi,
        largest_steps=1, backwards=passage.backwards,
    )  # fmt: skip
    torques = list(zip(passage.torque_time, passage.torque, strict=True))
    done = walk(model, passage.stance, x0, duration, None, options, law, torques)
    if not done.impacts:
        return None
    event = done.impacts[0]
    after = _rates_after(model, passage, event.time, sigma)
    if after is None:
        return None
    rates, covariance = after
    results = foot_functions(model, passage.stance, True)(
        event.x[:2], np.concatenate([event.x[2:4], np.zeros(2)]), parameters(model)
    )
    u, W, G = (np.asarray(part) for part in results)
    ground = Ground(float(own[4]))
    frame = np.vstack([ground.tangent, ground.normal])
    inverse = frame @ np.linalg.inv(G[:2])
    before = np.linalg.inv(passage.root.T @ passage.root)[2:4, 2:4]
    plastic, _ = contact_impulse(u.ravel(), W, ContactLaw(), ground)
    return Impulse(
        passage.name,
        inverse @ (rates - event.x[2:4]),
        inverse @ (covariance + before) @ inverse.T,
        frame @ plastic,
    )


def _rates_after(
    model: Model, passage: Passage, instant: float, sigma: np.ndarray
) -> tuple[np.ndarray, np.ndarray] | None:
    """Rates of the legs in rad/s right after an instant, and their covariance."""
    names, since = model.mechanism.outputs, passage.time - instant
    rates, variances = {}, {}
    for name, degree in (('imu_angle', 2), ('imu_rate', 2), ('hip_angle', 2)):
        j = names.index(name)
        values = passage.outputs[:, j]
        rows = (since > 0) & (since <= AFTER_S) & np.isfinite(values)
        if rows.sum() < FEWEST_IN_PARABOLA:
            continue
        solve = np.linalg.pinv(np.vander(since[rows], degree + 1, increasing=True))
        weights = solve[0] if name == 'imu_rate' else solve[1]
        rates[name] = float(weights @ values[rows])
        variances[name] = float(sigma[j] ** 2 * weights @ weights)
    inner = 'imu_rate' if 'imu_rate' in rates else 'imu_angle'
    if inner not in rates or 'hip_angle' not in rates:
        return None
    # The encoder sees inner less outer.
    a, b = variances[inner], variances['hip_angle']
    return (
        np.array([rates[inner], rates[inner] - rates['hip_angle']]),
        np.array([[a, a], [a, a + b]]),
    )
