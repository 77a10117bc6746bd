"""What is said of a run, from how the robot fared."""

import pytest

from cg_bringup.verdict import balance_verdict, rebalance_verdict, recovery_verdict
from cg_hardware.standing import Outcome, Standing

SAMPLE = 0.002  # s


def watched(leans, fall_angle=0.6, stances=None):
    standing = Standing(fall_angle, 'inner', SAMPLE)
    for k, lean in enumerate(leans):
        stance = 'inner' if stances is None else stances[k]
        if not standing.see((k + 1) * SAMPLE, stance, lean):
            break
    return standing.outcome


def test_a_robot_that_stands():
    outcome = watched([0.1, -0.15, *[0.01] * 998])
    assert (outcome.duration, outcome.largest_lean, outcome.last_lean) == (2.0, 0.15, 0.01)
    verdict = balance_verdict(outcome, [0.5, 0.3, 1.0, -0.3, 5.0, 0.3])
    assert verdict.worked
    assert verdict.line == (
        'upright throughout: 2.00 s on the inner leg, largest lean 0.150 rad, '
        '2 of 3 pushes survived'
    )


def test_a_robot_that_falls():
    outcome = watched([*[0.0] * 499, 0.7, 0.8])
    assert outcome.fell_at == outcome.duration == 1.0
    verdict = balance_verdict(outcome, [0.4, 3.0, 2.0, 3.0])
    assert not verdict.worked
    assert verdict.line == 'fell at 1.00 s on the inner leg, 0.60 s after push 1 of 2'


def test_a_robot_that_falls_when_time_is_over():
    verdict = balance_verdict(watched([0.3] * 10))
    assert not verdict.worked
    assert verdict.line.startswith('falling at the end: lean 0.300 rad')


def test_a_machine_that_never_began():
    assert not balance_verdict(watched([])).worked
    assert not rebalance_verdict(watched([]), 'inner').worked


def test_one_step_is_what_was_asked():
    outcome = watched([0.1] * 500, stances=['inner'] * 250 + ['outer'] * 250)
    verdict = rebalance_verdict(outcome, 'inner')
    assert verdict.worked
    assert verdict.line.startswith('stepped off the inner leg at 0.50 s, upright throughout')
    assert 'on the outer leg' in verdict.line


@pytest.mark.parametrize(
    ('stances', 'asked', 'worked', 'words'),
    [
        (['inner'] * 400, True, False, 'no step'),
        (['inner'] * 400, False, True, 'no step'),
        (['inner'] * 100 + ['outer'] * 100 + ['inner'] * 200, True, False, '2 steps instead of 1'),
    ],
)
def test_another_count_of_steps(stances, asked, worked, words):
    verdict = rebalance_verdict(watched([0.0] * 400, stances=stances), 'inner', asked)
    assert verdict.worked == worked
    assert verdict.line.startswith(words.replace('of 1', 'of one').replace(' 1', ' one'))


def test_a_robot_that_comes_home_takes_the_steps_that_it_takes():
    outcome = watched([0.3] * 250 + [0.01] * 750, stances=['inner'] * 250 + ['outer'] * 750)
    verdict = recovery_verdict(outcome, [1.0, 0.5])
    assert verdict.worked
    assert verdict.line == (
        'upright at the end: 2.00 s on the outer leg, largest lean 0.300 rad, '
        '1 of 1 pushes survived, step at 0.50 s'
    )
    verdict = recovery_verdict(watched([0.1] * 500 + [0.7]))
    assert not verdict.worked
    assert verdict.line == 'fell at 1.00 s on the inner leg'


def test_outcome_is_kept_in_a_file(tmp_path):
    outcome = watched([0.0, 0.7], stances=['inner', 'outer'])
    outcome.save(tmp_path / 'outcome.json')
    assert Outcome.load(tmp_path / 'outcome.json') == outcome
