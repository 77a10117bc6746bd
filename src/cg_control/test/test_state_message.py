"""What is read in a /state message, and what is refused."""

from types import SimpleNamespace

import pytest

from cg_control.state_message import state_of


def message(names=('inner', 'outer'), frame='outer_foot', q=None, v=None):
    q = [float(k) for k in range(len(names))] if q is None else q
    v = [10.0 + k for k in range(len(names))] if v is None else v
    header = SimpleNamespace(frame_id=frame)
    return SimpleNamespace(header=header, name=list(names), position=q, velocity=v)


def test_joints_are_found_by_name():
    stance, x = state_of(message(('outer', 'knee', 'inner')))
    assert stance == 'outer'
    assert x.tolist() == [2.0, 0.0, 12.0, 10.0]


def test_a_rotor_comes_behind():
    _, x = state_of(message(('hip_rotor', 'inner', 'outer')))
    assert x.tolist() == [1.0, 2.0, 11.0, 12.0, 0.0, 10.0]


@pytest.mark.parametrize(
    ('given', 'said'),
    [
        (message(frame='middle_foot'), "frame_id is 'middle_foot'"),
        (message(v=[1.0]), 'without as many positions and velocities'),
        (message(('inner', 'knee')), r"state of \['inner', 'knee'\]"),
    ],
)
def test_what_is_missing_is_named(given, said):
    with pytest.raises(ValueError, match=said):
        state_of(given)
