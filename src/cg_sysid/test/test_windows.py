"""How far records can be followed, and the windows that follow from it."""

import math
from dataclasses import replace

import numpy as np
import pytest

from cg_description.paths import model_path
from cg_dynamics.model import Model
from cg_dynamics.rig import Setup, Spring
from cg_sysid.checks.loading import load_bags
from cg_sysid.diagnosis.diagnose import judging_whole
from cg_sysid.experiments.rehearsal import rehearse
from cg_sysid.identification.data_set import prepare
from cg_sysid.identification.windows import (
    FOLLOWED,
    SHORTEST_WINDOW,
    Followed,
    Windows,
    followed,
    sensitivities,
    windows_of,
)
from cg_sysid.records.bags import write_bag

G = 9.81  # m/s^2
SPRINGS = tuple(Spring('inner', 1.0, (x, 1.0), 200.0, 0.5) for x in (1.3, -1.3))


@pytest.fixture(scope='module')
def nominal(model_file):
    return Model.load(model_file)


def record(machine, setup, start, torque=0.0, duration=4.0):
    given = [lambda t: torque * math.sin(2 * math.pi * (0.4 + 0.2 * t) * t)]
    return rehearse('record', machine, setup, start, given, duration, 0.004, 1)


@pytest.fixture(scope='module')
def pendulum():
    """The published leg without friction: a pendulum as in textbooks."""
    model = Model.load(model_path('sydney_pendulum'))
    for effect in model.effects:
        model = model.without_effect(effect.label)
    return model


def frequency(pendulum):
    """Of small swings in rad/s, measured on a simulated one: two zero crossings apart."""
    swing = record(pendulum, Setup(), [0.02, 0.0], duration=3.0)
    t, angle = swing.samples('angle')
    falls = t[1:][(angle[:-1] > 0) & (angle[1:] <= 0)]
    return 2 * math.pi / np.diff(falls).mean()


def test_upright_an_error_grows_as_the_inverted_pendulum_says(pendulum):
    """Near upright d2(delta)/dt2 = omega^2 delta: exp(omega t), omega of the hanging leg."""
    omega = frequency(pendulum)
    upright = record(pendulum, Setup(), [math.pi + 1e-3, 1e-3 * omega], duration=0.5)
    _, maps = sensitivities(pendulum, prepare(pendulum, [upright])[0])
    whole = np.linalg.multi_dot([*reversed(maps)])
    largest = np.abs(np.linalg.eigvals(whole)).max()
    # Two per cent: the measured starts lie up to 0.03 rad off upright, and omega was read off
    # crossings of zero between rows of 4 ms.
    assert np.log(largest) == pytest.approx(omega * upright.duration, rel=0.02)


def test_what_hangs_is_followed_to_its_end(pendulum):
    """A swing keeps its errors but for a drift of phase, linear in time."""
    swing = record(pendulum, Setup(), [0.5, 0.0], duration=20.0)
    (found,) = followed(pendulum, [swing])
    assert found.whole
    assert 1.0 <= found.growth < FOLLOWED / 5
    assert windows_of(swing, found) == [swing]


def test_a_robot_on_springs_is_followed_to_its_end(nominal):
    held = record(nominal, Setup('inner', springs=SPRINGS), [0.1, -0.1, 0.3, -0.5], 4.0, 8.0)
    assert followed(nominal, [held])[0].whole


def test_what_stands_upright_is_cut_where_the_error_has_grown_a_hundredfold(pendulum):
    stands = record(pendulum, Setup(), [math.pi, 0.0], duration=4.0)
    (found,) = followed(pendulum, [stands])
    assert found.growth > 1e6
    # exp(omega t) = 100, found on a grid of 0.1 s; where it rests, the weight of the rate is none
    # of its motion's and makes the norm larger by a factor of up to 3.
    expected = math.log(FOLLOWED) / frequency(pendulum)
    longest = max(np.diff([0.0, *found.cuts]))
    assert expected - math.log(3) / frequency(pendulum) - 0.1 < longest < expected + 0.1
    parts = windows_of(stands, found)
    assert len(parts) == len(found.cuts) + 1
    assert sum(len(part) for part in parts) == len(stands)  # nothing is left out
    assert all(part.duration > 0.9 * SHORTEST_WINDOW for part in parts)


def test_bags_are_cut_where_they_cannot_be_followed(pendulum, tmp_path):
    made = {
        'swings': record(pendulum, Setup(), [0.5, 0.0], duration=3.0),
        'stands': record(pendulum, Setup(), [math.pi, 0.0], duration=3.0),
    }
    bags = [write_bag(tmp_path / name, replace(r, name=name)) for name, r in made.items()]
    model_file = tmp_path / 'pendulum.yaml'
    pendulum.save(model_file)
    loaded = load_bags(bags, model_file)
    whole, lost = loaded.windows.records
    assert (whole.name, whole.whole, lost.whole) == ('swings', True, False)
    assert loaded.wholes == ()
    assert loaded.records[0].name == 'swings'
    parts = [r for r in loaded.records if loaded.origin[r.name] == 'stands']
    assert len(parts) == len(lost.cuts) + 1 > 2
    chosen = load_bags(bags, model_file, window=1.0)
    assert chosen.windows.chosen == 1.0
    # Of what cannot be followed no whole can judge, whoever chose the windows.
    assert [r.name for r in chosen.wholes] == ['swings']


def test_what_is_told():
    whole, lost = Followed('calm', 2.0), Followed('wild', 3e8, (1.5, 2.5))
    assert Windows((whole,)).text == 'every record is fitted and judged whole'
    told = Windows((whole, lost)).text
    assert 'wild in 3 windows' in told
    assert '10^8' in told
    assert 'the other 1 whole' in told
    assert 'chosen by you' in Windows((whole, lost), 1.5).text


def test_whole_recordings_judge_in_place_of_windows_that_a_person_chose(nominal):
    setup = Setup('inner', springs=SPRINGS)
    made = record(nominal, setup, [0.1, -0.1, 0.3, -0.5], 4.0, 4.0)
    windows = made.segments(1.0)
    *parts, whole = prepare(nominal, [*windows, made])
    assert judging_whole(parts, [], [whole]) == [whole]
    # Some of it is fitted: it cannot judge.
    assert judging_whole(parts[1::2], parts[::2], [whole]) == parts[1::2]
    assert judging_whole(parts, [], []) == parts
