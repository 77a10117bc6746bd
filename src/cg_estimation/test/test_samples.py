"""Messages of one instant become one measurement."""

from cg_estimation.samples import Gatherer

T = 2_000_000


def whole(gatherer, k, torque=None):
    """All parts of sample k, in the order of the machine."""
    gatherer.add(k * T, {'hip_angle': float(k)})
    gatherer.add_contact(k * T, 'inner', True)
    gatherer.add_contact(k * T, 'outer', False)
    gatherer.add(k * T, {'imu_angle': 0.0, 'imu_rate': 0.0})
    if torque is not None:
        gatherer.add_torque(k * T, torque)


def test_a_whole_measurement_carries_the_torque_held_before_it():
    gatherer = Gatherer()
    whole(gatherer, 1)
    (first,) = gatherer.due()
    assert (first.stamp_ns, first.torque, first.stance) == (T, 0.0, 'inner')
    gatherer.add_torque(T, 3.0)
    whole(gatherer, 2)
    (second,) = gatherer.due()
    assert second.torque == 3.0


def test_it_waits_for_the_torque_of_the_interval():
    gatherer = Gatherer()
    whole(gatherer, 1, torque=1.0)
    list(gatherer.due())
    whole(gatherer, 2)
    list(gatherer.due())
    whole(gatherer, 3)
    # The torque latched at 2 is not known yet.
    assert list(gatherer.due()) == []
    gatherer.add_torque(2 * T, 5.0)
    assert [m.torque for m in gatherer.due()] == [5.0]


def test_parts_are_given_out_once_newer_samples_have_come():
    gatherer = Gatherer()
    for k in (1, 2, 3):
        gatherer.add(k * T, {'imu_angle': 0.0})
    assert [(m.stamp_ns, list(m.outputs)) for m in gatherer.due()] == [(T, ['imu_angle'])]


def test_what_is_late_or_repeated_is_not_given_out_again():
    gatherer = Gatherer()
    whole(gatherer, 5)
    list(gatherer.due())
    whole(gatherer, 5)
    whole(gatherer, 4)
    assert list(gatherer.due()) == []


def test_a_machine_that_died_does_not_keep_the_next_one_waiting():
    """It owes the torque of its last sample; the next one repeats its first measurement."""
    gatherer = Gatherer()
    whole(gatherer, 1, torque=1.0)
    whole(gatherer, 2)
    assert len(list(gatherer.due())) == 2
    gatherer.add(3 * T, {'hip_angle': 3.0})  # half a measurement, and no torque at 2
    given = []
    for _ in range(3):
        whole(gatherer, 900)
        given += gatherer.due()
    assert [m.stamp_ns // T for m in given] == [3, 900]


def test_without_foot_contacts_the_stance_leg_must_be_told_otherwise():
    told = Gatherer(contacts=False)
    told.add(T, {'imu_angle': 0.0, 'hip_angle': 0.0})
    assert len(list(told.due())) == 1
    asking = Gatherer()
    asking.add(T, {'imu_angle': 0.0, 'hip_angle': 0.0})
    assert list(asking.due()) == []


def test_both_feet_down_do_not_tell_which_one_stands():
    gatherer = Gatherer()
    gatherer.add_contact(T, 'inner', True)
    gatherer.add_contact(T, 'outer', True)
    gatherer.add(T, {'imu_angle': 0.0, 'hip_angle': 0.0})
    assert [m.stance for m in gatherer.due()] == [None]


def test_the_leg_that_lands_stands_from_its_first_touch_on():
    gatherer = Gatherer()
    heard = []
    for k, (inner, outer) in enumerate([(1, 0), (1, 0), (1, 1), (1, 1), (0, 1), (0, 1)], start=1):
        gatherer.add(k * T, {'imu_angle': 0.0, 'hip_angle': 0.0})
        gatherer.add_contact(k * T, 'inner', bool(inner))
        gatherer.add_contact(k * T, 'outer', bool(outer))
        heard += [m.stance for m in gatherer.due()]
        gatherer.add_torque(k * T, 0.0)
    # Both feet down tell nothing new.
    assert heard == ['inner', 'inner', 'outer', None, 'outer', 'outer']


def apart(gatherer, k, lag=0):
    """An IMU and a drive on clocks of their own; the drive's sample is `lag` ns older."""
    gatherer.add(k * T - lag, {'hip_angle': float(k)})
    gatherer.add(k * T, {'imu_angle': 0.1 * k, 'imu_rate': 0.0})
    return list(gatherer.due())


def test_stamps_that_never_meet_are_not_waited_for():
    gatherer = Gatherer(contacts=False)
    given = [apart(gatherer, k, lag=700_000) for k in range(1, 40)]
    assert gatherer.apart
    # Until that is known two IMU samples are waited for each; then each is a measurement at once.
    for k, found in enumerate(given[-10:], 30):
        (measurement,) = found
        assert measurement.stamp_ns == k * T
        assert measurement.outputs == {'imu_angle': 0.1 * k, 'imu_rate': 0.0, 'hip_angle': k}
        assert measurement.late == {'hip_angle': 7e-4}


def test_an_encoder_that_is_too_old_is_left_out_and_one_that_meets_again_is_waited_for():
    gatherer = Gatherer(contacts=False)
    for k in range(1, 40):
        apart(gatherer, k, lag=700_000)
    gatherer.add(47 * T, {'imu_angle': 0.0})
    (measurement,) = gatherer.due()
    assert measurement.outputs == {'imu_angle': 0.0}
    apart(gatherer, 50)
    assert not gatherer.apart


def test_a_landing_between_two_measurements_is_not_lost():
    gatherer = Gatherer()
    for k in range(1, 40):
        for leg, on in (('inner', True), ('outer', False)):
            gatherer.add_contact(k * T - 1, leg, on)
        apart(gatherer, k, lag=700_000)
    assert gatherer.apart
    gatherer.add_contact(40 * T - 3, 'outer', True)
    gatherer.add_contact(40 * T - 2, 'inner', True)  # still down: nothing new
    (measurement,) = apart(gatherer, 40, lag=700_000)
    assert measurement.stance == 'outer'
    gatherer.add_contact(41 * T - 2, 'inner', False)
    assert apart(gatherer, 41, lag=700_000)[0].stance == 'outer'
