"""The answer in words."""

from cg_sysid.diagnosis import Cause, Gain, summary_of


def test_a_ratio_is_printed_without_a_unit_and_a_torque_with_its_own():
    gain = Gain('hip_angle', 'rad', 1e-2, 1e-4, 1e-4)
    causes = [
        Cause('imu_scale', {'scale': (1.0216, 1e-3, '1')}, 100.0),
        Cause('torque_bias', {'torque': (0.8, 0.01, 'N m')}, 50.0),
    ]
    text = summary_of('explained', causes, (gain,), {})
    assert 'imu_scale (scale = 1.02 +- 0.001)' in text
    assert 'torque_bias (torque = 0.8 +- 0.01 N m)' in text
