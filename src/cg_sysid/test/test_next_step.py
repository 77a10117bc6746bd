"""Every verdict says what to do next, and what it says is of these records."""

import copy
import io

import pytest
from rich.console import Console
from test_report import with_verdict

from cg_dynamics.effects import LIBRARY
from cg_sysid.cli.common import print_next
from cg_sysid.diagnosis.next_step import CHECKS, next_step
from cg_sysid.report import render
from cg_sysid.report.diagnosis_file import VERDICTS

PROPOSAL = {
    'experiment': 'legs_tied', 'excitation': {'kind': 'multisine', 'f_max': 8.0},
    'duration_s': 20.0, 'expected_nats': 40.0, 'tells_apart': ['torque_bias', 'ground_slope'],
}  # fmt: skip


@pytest.mark.parametrize('verdict', VERDICTS)
def test_every_verdict_has_one_in_the_file_the_report_and_on_the_screen(facts, verdict):
    made = with_verdict(facts, verdict)
    made['next'] = next_step(made)
    assert made['next'].endswith('.')
    assert made['next'] in render(made, [])
    console = Console(width=2000, record=True, file=io.StringIO())
    print_next(console, made)
    assert made['next'] in console.export_text()


def test_no_two_verdicts_say_the_same(facts):
    said = [next_step(with_verdict(facts, verdict)) for verdict in VERDICTS]
    assert len(set(said)) == len(VERDICTS)


def test_an_experiment_is_named_only_if_it_is_worth_something(facts):
    made = with_verdict(facts, 'ambiguous')
    made['causes'][0]['next_experiments'] = [PROPOSAL]
    assert 'Run legs_tied (multisine up to 8.00 Hz, 20.0 s)' in next_step(made)
    for worthless in (0.0, None):
        made['causes'][0]['next_experiments'] = [{**PROPOSAL, 'expected_nats': worthless}]
        assert 'legs_tied' not in next_step(made)
        assert 'No experiment that can be launched' in next_step(made)


def test_a_search_that_was_broken_off_can_go_on_whatever_it_found(facts):
    for verdict in ('explained', 'unfinished'):
        made = with_verdict(facts, verdict)
        assert '--budget' not in next_step(made)
        made['unfinished'] = {'text': '', 'ranking': []}
        assert '--budget' in next_step(made)


def test_numbers_that_the_file_rules_out_are_measured(facts):
    made = with_verdict(facts, 'consistent')
    made['parameters'] = copy.deepcopy(made['parameters'])
    moved = next(p for p in made['parameters'] if p['moved_tolerances'] is not None)
    for tolerances, told in ((3.9, False), (-4.1, True)):
        moved['moved_tolerances'] = tolerances
        assert (f'Measure {moved["name"]}' in next_step(made)) == told


def test_what_to_check_is_where_the_cause_acts(facts):
    made = with_verdict(facts, 'explained')
    assert CHECKS[LIBRARY['torque_bias'].place] in next_step(made)
    assert {effect.place for effect in LIBRARY.values()} <= set(CHECKS)
