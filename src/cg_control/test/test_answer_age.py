"""Ages of measurements, from what was sent and what was latched."""

from cg_control.answer_age import AnswerAges

MS = 1_000_000


def test_ages_and_missed_deadlines():
    ages = AnswerAges()
    for tick in range(4):
        ages.sent(tick * 2 * MS, float(tick))
        ages.latched(tick * 2 * MS + (5 if tick == 3 else 2) * MS, float(tick), 0.004)
    assert (len(ages), ages.missed) == (4, 1)
    found = ages.figures(0.004)
    assert found['missed_deadlines'] == 1
    assert (found['age_p50_ms'], found['age_max_ms']) == ('2.000', '5.000')
    assert ages.figures(0.004)['missed_deadlines'] == 0


def test_equal_torques_tell_nothing():
    ages = AnswerAges()
    ages.sent(0, 0.0)
    ages.sent(2 * MS, 0.0)
    ages.latched(4 * MS, 0.0, 0.004)
    ages.latched(4 * MS, 7.0, 0.004)
    assert len(ages) == 0


def test_old_answers_are_forgotten():
    ages = AnswerAges()
    for tick in range(30):
        ages.sent(tick * 2 * MS, float(tick))
    ages.latched(60 * MS, 5.0, 0.004)
    assert len(ages) == 0
