"""Stamps as whole nanoseconds."""

import struct

import pytest
from rosbags.typesys import Stores, get_typestore

from cg_interfaces.stamps import stamp_of

STORE = get_typestore(Stores.ROS2_JAZZY)


@pytest.mark.parametrize('stamp_ns', [0, 1_764_400_000_000_000_001, -500_000_000])
def test_the_stamp_of_a_serialised_message_is_that_of_its_header(stamp_ns):
    seconds, nanoseconds = divmod(stamp_ns, 10**9)
    kinds = STORE.types
    stamp = kinds['builtin_interfaces/msg/Time'](sec=seconds, nanosec=nanoseconds)
    header = kinds['std_msgs/msg/Header'](stamp=stamp, frame_id='inner_foot')
    temperature = kinds['sensor_msgs/msg/Temperature'](header, 21.5, 0.1)
    data = bytes(STORE.serialize_cdr(temperature, 'sensor_msgs/msg/Temperature'))
    assert stamp_of(data) == stamp_ns


def test_what_is_shorter_than_a_header_has_no_stamp():
    with pytest.raises(struct.error):
        stamp_of(b'\x00\x01\x00\x00\x05')
