"""The design model: what is left out, and that its sampled form is that of the simulation."""

import numpy as np
import pytest

from cg_control.balancing.linearise import design_model, discretise, linearise_stance
from cg_control.balancing.lqr import lqr
from cg_description.paths import model_path
from cg_dynamics.assemble import parameter_vector
from cg_dynamics.model import Model
from cg_dynamics.rig import Setup
from cg_dynamics.rollout.compiled import compile_model

MODEL = Model.load(model_path('compass_gait_mit'))
FLEXIBLE = MODEL.with_effect(
    'joint_flexibility', stiffness=1500.0, rotor_inertia=0.5, damping=1.0
).with_effect('actuator_delay', delay=0.003)


def test_design_model_keeps_bodies_and_viscous_friction_only():
    assert [effect.name for effect in design_model(MODEL).effects] == ['viscous_friction']
    late = MODEL.with_effect('actuator_delay', delay=0.003).with_effect('imu_offset', offset=0.01)
    np.testing.assert_array_equal(
        linearise_stance(late, 'inner').A, linearise_stance(MODEL, 'inner').A
    )


def test_rotor_behind_a_spring_turns_with_the_joint():
    """The design model is the limit of a stiff spring."""
    kept = design_model(FLEXIBLE)
    assert kept.values['rotor_inertia.inertia'] == 0.5
    added = design_model(FLEXIBLE.with_effect('rotor_inertia', inertia=0.1))
    assert added.values['rotor_inertia.inertia'] == pytest.approx(0.6)
    stiff = FLEXIBLE.with_values(
        {'joint_flexibility.stiffness': 1e5, 'joint_flexibility.damping': 1.0}
    )
    slow = np.sort_complex(np.linalg.eigvals(linearise_stance(stiff, 'inner', elastic=True).A))
    slow = slow[np.abs(slow) < 10]
    rigid = np.sort_complex(np.linalg.eigvals(linearise_stance(FLEXIBLE, 'inner').A))
    # A spring of 1e5 N m/rad resonates at 500 1/s: (3/500)^2 of the eigenvalues.
    np.testing.assert_allclose(slow, rigid, rtol=1e-4)


def test_upright_eigenvalues_are_those_of_the_frictionless_robot():
    frictionless = MODEL.without_effect('viscous_friction')
    values = np.linalg.eigvals(linearise_stance(frictionless, 'inner').A)
    # Re-derived by hand from Eq. 4.4 to 4.6: +-3.18 and +-2.92i 1/s.
    np.testing.assert_allclose(np.sort(values.real)[[0, 3]], [-3.18, 3.18], atol=0.005)
    np.testing.assert_allclose(np.sort(values.imag)[[0, 3]], [-2.92, 2.92], atol=0.005)


def test_hip_torque_keeps_its_sign_and_gains_change_theirs_with_the_stance_leg():
    gains = {}
    for stance, column in (('inner', 0), ('outer', 1)):
        linear = linearise_stance(MODEL, stance)
        assert linear.B[2, 0] - linear.B[3, 0] > 0  # it drives the hip angle up
        regulator = lqr(linear.A, linear.B, np.eye(4), np.eye(1))
        gains[stance] = regulator.K[0, column]
    # A forward lean of the stance leg asks the motor to throw the swing leg forward.
    assert gains['inner'] * gains['outer'] < 0


@pytest.mark.parametrize('stance', ['inner', 'outer'])
def test_sampled_form_is_the_derivative_of_the_simulation(stance):
    x0, u0, T = np.array([0.1, -0.2, 0.3, 0.4]), np.array([2.0]), 0.01
    setup = Setup(stance=stance)
    design = design_model(MODEL)
    compiled, p = compile_model(design, setup), parameter_vector(design, setup)

    def after(x, u):
        x = x.copy()
        compiled.advance(x, u, p, T / 20, 20)
        return x

    sampled = discretise(linearise_stance(MODEL, stance, x0, u0), T)
    # Both are exact to first order; what differs is the change of A over the sample, T^2 A'.
    np.testing.assert_allclose(after(x0, u0) - x0, sampled.c, atol=5e-4)
    step = 1e-6
    for j, direction in enumerate(np.eye(4)):
        slope = (after(x0 + step * direction, u0) - after(x0 - step * direction, u0)) / (2 * step)
        np.testing.assert_allclose(slope, sampled.A[:, j], atol=2e-3)
    slope = (after(x0, u0 + step) - after(x0, u0 - step)) / (2 * step)
    np.testing.assert_allclose(slope, sampled.B[:, 0], atol=2e-4)


def test_sample_time_must_be_positive():
    with pytest.raises(ValueError, match='sample_time is 0'):
        discretise(linearise_stance(MODEL, 'inner'), 0.0)
