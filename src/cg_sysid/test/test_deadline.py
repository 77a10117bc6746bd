"""Work that ends in time: the best answer so far, marked as such, and fits that are kept."""

import json
import os
import signal
import subprocess
import sys
import threading
import time
from dataclasses import replace

import numpy as np
import pytest
from searches import search_for

from cg_dynamics.model import Model
from cg_dynamics.rig import Setup
from cg_sysid import parallel
from cg_sysid.cli import diagnose as diagnose_cli
from cg_sysid.deadline import Deadline, OutOfTime, check_time
from cg_sysid.diagnosis import conclude
from cg_sysid.diagnosis.conclude import LAST_FIT
from cg_sysid.diagnosis.diagnose import Options, diagnose
from cg_sysid.diagnosis.early_end import answer_so_far
from cg_sysid.experiments.rehearsal import rehearse
from cg_sysid.identification import identify, kept_fits
from cg_sysid.identification.data_set import led_in, prepare
from cg_sysid.identification.identify import fit, score
from cg_sysid.identification.unknowns import IdentificationError
from cg_sysid.search.task import Task
from cg_sysid.search.whole_fit import try_candidate

EFFECTS = ('torque_bias', 'sensor_delay', 'quadratic_friction')
MORE = (*EFFECTS, 'payload', 'actuator_lag', 'aerodynamic_drag', 'stribeck_friction')
PATIENCE = 60.0  # s until a subprocess has to have said something, however busy the machine


@pytest.fixture(scope='module')
def delayed(model_file):
    """A model and records of a robot whose sensors are 12 ms late."""
    model = Model.load(model_file)
    robot = model.with_effect('sensor_delay', delay=0.012)
    return model, [
        rehearse(
            f'swing_{k}', robot, Setup(fixture='inner_fixed'), [0.2, 1.0],
            [lambda t, k=k: 6.0 * np.sin(2 * np.pi * (0.6 + 0.3 * k) * t)], 4.5, 0.004, k,
        )
        for k in range(2)
    ]  # fmt: skip


class Ended:
    """A progress that asks for the end once a stage has come so far."""

    def __init__(self, stage: str, done: int = 1):
        self.deadline, self.stage, self.done = Deadline(), stage, done

    def __call__(self, what, done, total, best):
        if self.stage in what and done >= self.done:
            self.deadline.ask()


def broken_off(delayed, stage, done=1, **options):
    ended = Ended(stage, done)
    model, records = delayed
    given = Options(effects=EFFECTS, workers=0, **options)
    return diagnose(model, records, given, ended, deadline=ended.deadline)


def test_a_deadline_passes_or_is_brought_forward():
    now = [100.0]
    deadline = Deadline(5.0, clock=lambda: now[0])
    now[0] = 104.0
    assert deadline.left == 1.0
    assert not deadline.over
    now[0] = 106.0
    assert deadline.left == 0.0
    assert deadline.over
    assert deadline.why == 'stopped at the end of its budget of 5 s'
    asked = Deadline(clock=lambda: now[0])
    assert not asked.over
    now[0] = 109.0
    asked.ask()
    assert asked.over
    assert asked.why == 'interrupted after 3 s'


def test_loops_ask_the_deadline_of_their_thread():
    deadline = Deadline(0.0)
    check_time()  # nobody keeps one
    with deadline.kept():
        with pytest.raises(OutOfTime, match='budget of 0 s'):
            check_time()
        other = threading.Thread(target=check_time)
        other.start()
        other.join()
    check_time()


@pytest.mark.parametrize('workers', [0, 2])
def test_work_under_way_is_dropped_and_what_was_done_is_known(workers):
    """Of pieces of 0, 0, and 600 s the first two come back; then the pool is as new."""
    deadline, known = Deadline(), []

    def progress(done, total, result):
        known.append(done)
        if done == 2:
            deadline.ask()

    began = time.monotonic()
    with deadline.kept(), pytest.raises(OutOfTime):
        parallel.run_all(time.sleep, [(0.0,), (0.0,), (600.0,)], workers, progress=progress)
    assert time.monotonic() - began < PATIENCE
    assert known == [0, 1, 2]
    assert parallel.run_all(abs, [(-1,), (-2,)], workers) == [1, 2]


def test_a_fit_ends_between_its_iterations(delayed):
    model, records = delayed
    data_sets = prepare(model, records)
    with Deadline(0.0).kept(), pytest.raises(OutOfTime):
        fit(model, data_sets)


def test_first_looks_are_an_answer(delayed):
    """Broken off before any whole fit: no cause is named, but the delay leads the ranking."""
    found = broken_off(delayed, 'first look', done=3)
    assert found.verdict == 'unfinished'
    assert not found.causes
    assert found.unfinished.ranking[0].label == 'sensor_delay'
    assert not found.unfinished.ranking[0].whole
    assert {'sensor_delay', 'quadratic_friction'} < set(found.unfinished.not_fitted)
    assert 'so far' in found.summary
    assert found.unfinished.text in found.summary


def test_candidates_that_were_not_tried_are_named(delayed):
    found = broken_off(delayed, 'first look', done=1)
    tried = {standing.label for standing in found.unfinished.ranking}
    assert len(tried) == 1
    assert set(EFFECTS) - tried <= set(found.unfinished.not_tried)
    assert not tried & set(found.unfinished.not_tried)
    for label in found.unfinished.not_tried:
        assert label in found.summary


def test_what_was_fitted_is_judged(delayed):
    """Broken off when the delay was fitted: it is named, and its doubt is told as not done."""
    found = broken_off(delayed, 'effects on top of nominal + sensor_delay')
    if found.unfinished is None:  # nothing was left to look for
        found = broken_off(delayed, 'thorough')
    assert found.verdict == 'explained'
    (cause,) = found.causes
    assert cause.label == 'sensor_delay'
    assert cause.parameters['delay'][0] == pytest.approx(0.012, abs=2e-4)
    assert cause.evidence > 100
    assert any('doubt' in step for step in found.unfinished.steps)
    hip = next(gain for gain in found.gains if gain.channel == 'hip_angle')
    assert hip.after < 0.5 * hip.before


def test_numbers_of_the_model_are_those_of_all_records(delayed):
    """What judges is held out until the answer stands; whoever simulates gets what all say."""
    model, records = delayed
    found = diagnose(model, records, Options(effects=('sensor_delay',), workers=0))
    assert found.from_all
    assert found.unfinished is None
    both = [led_in(data_set) for data_set in prepare(model, records)]
    (name,) = (n for n in found.model.quantities if n.endswith('.delay'))
    judged, given = (m.quantities[name] for m in (found.extended.train.model, found.model))
    assert given.value == pytest.approx(0.012, abs=5 * given.tolerance)
    # Twice the records leave at most the root of a half of the uncertainty, and the second one
    # moves faster.
    assert given.tolerance < 0.75 * judged.tolerance
    left, with_half = (score(m, both).squares for m in (found.model, found.extended.train.model))
    assert left < with_half


def test_without_time_for_the_last_fit_the_model_has_numbers_of_training(delayed, monkeypatch):
    def over(*_):
        raise OutOfTime

    monkeypatch.setattr(conclude, 'fitted_to_all', over)
    model, records = delayed
    found = diagnose(model, records, Options(effects=('sensor_delay',), workers=0))
    assert found.verdict == 'explained'
    assert found.unfinished.steps == (LAST_FIT,)
    assert LAST_FIT in found.summary
    assert not found.from_all
    assert found.model.values == found.extended.train.model.values


def test_a_trial_without_small_faults_is_no_answer_where_it_leaves_more(model_file):
    """Causes are asked whether they do without them; until then they are as they were found."""
    nominal = Model.load(model_file)
    machine = nominal.with_effect('torque_constant', error=0.1).with_effect('gyro_bias', bias=0.02)
    work = search_for(nominal, machine)
    alone = try_candidate(Task(nominal), work.train, work.held)
    lean = try_candidate(Task(nominal, ('torque_constant', None)), work.train, work.held)
    rich = try_candidate(Task(lean.model, ('gyro_bias', None)), work.train, work.held)
    bounds = {'gyro_bias.bias': 0.01}
    found = replace(rich, label=lean.label, task=replace(rich.task, bounds=bounds))
    work.found, work.under_way = found, lean
    work.so_far.note(lean)
    answer = answer_so_far(work, alone)
    assert [c.label for c in answer.causes] == ['torque_constant']
    assert answer.extended.held.normalised_error == found.held.normalised_error
    # Who leaves less is the answer.
    work.found, work.under_way = lean, found
    answer = answer_so_far(work, alone)
    assert answer.extended.held.normalised_error == found.held.normalised_error


def test_without_a_fit_of_the_model_there_is_no_answer(delayed):
    model, records = delayed
    with pytest.raises(OutOfTime):
        diagnose(model, records, Options(effects=EFFECTS, workers=0), deadline=Deadline(0.0))


def test_a_search_goes_on_from_what_is_kept(delayed, tmp_path, monkeypatch):
    """The same answer as of one go, to the last digit, and no fit is done twice."""
    descents = []
    descend = identify._descend

    def counted(problem, *arguments):
        descents.append(problem.model.name)
        return descend(problem, *arguments)

    monkeypatch.setattr(identify, '_descend', counted)
    model, records = delayed
    options = Options(effects=EFFECTS, workers=0)
    at_once = diagnose(model, records, options)
    needed = len(descents)
    descents.clear()
    kept = tmp_path / 'fits'
    first = broken_off(delayed, 'first look', done=3, kept=kept)
    assert first.unfinished is not None
    before = len(descents)
    assert 0 < before < needed
    # Files that were damaged since are fitted again.
    some = sorted(kept.iterdir())[0]
    some.write_text(some.read_text()[:40])
    other = sorted(kept.iterdir())[1]
    other.write_text('{"theta": 1}')
    rest = diagnose(model, records, Options(effects=EFFECTS, workers=0, kept=kept))
    assert len(descents) == needed + 2
    assert rest.verdict == at_once.verdict
    assert [cause.parameters for cause in rest.causes] == [
        cause.parameters for cause in at_once.causes
    ]
    assert [cause.evidence for cause in rest.causes] == [c.evidence for c in at_once.causes]


def test_what_decides_a_fit_names_its_file(delayed, tmp_path):
    model, records = delayed
    data_sets = prepare(model, records)
    louder = prepare(model, [records[1], records[0]])
    assert kept_fits.place_of(model, data_sets) is None
    with kept_fits.kept_in(tmp_path):
        places = [
            kept_fits.place_of(model, data_sets, reach=1.0),
            kept_fits.place_of(model, data_sets, reach=2.0),
            kept_fits.place_of(model, louder, reach=1.0),
            kept_fits.place_of(model.with_effect('torque_bias'), data_sets, reach=1.0),
        ]
        assert kept_fits.place_of(model, prepare(model, records), reach=1.0) == places[0]
    assert len(set(places)) == len(places)


@pytest.mark.parametrize('budget', ['0', '-1', 'nan'])
def test_a_budget_is_a_time(budget, tmp_path, capsys):
    words = ['--model', 'm', '--out', str(tmp_path), '--budget', budget, 'bag']
    assert diagnose_cli.main(words) == 2
    assert 'must be positive (s), inf is allowed' in capsys.readouterr().err


def test_the_command_line_answers_in_time_and_goes_on(bags, model_file, tmp_path, capsys):
    words = ['--model', str(model_file), '--out', str(tmp_path), '--effects', ','.join(EFFECTS),
             '--workers', '1', '--quiet', *map(str, bags)]  # fmt: skip
    assert diagnose_cli.main(['--budget', '1e-3', *words]) == 130
    said = capsys.readouterr().err
    assert 'budget of 0.001 s before the model was fitted once' in said
    assert diagnose_cli.main(['--budget', 'inf', *words]) == 0
    assert not (tmp_path / 'fits').exists()
    facts = json.loads((tmp_path / 'diagnosis.json').read_text('utf-8'))
    assert facts['unfinished'] is None


def test_an_interrupt_ends_with_the_best_so_far(bags, model_file, tmp_path):
    """SIGINT to a command at work: an answer, files of it, and fits to go on from."""
    command = [sys.executable, '-m', 'cg_sysid.cli.diagnose', '--model', str(model_file),
               '--out', str(tmp_path / 'out'), '--effects', ','.join(MORE), '--workers', '1',
               *map(str, bags)]  # fmt: skip
    started = subprocess.Popen(
        command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True,
        env={**os.environ, 'PYTHONUNBUFFERED': '1'},
        preexec_fn=lambda: signal.signal(signal.SIGINT, signal.default_int_handler),
    )  # fmt: skip
    fits = tmp_path / 'out' / 'fits'
    deadline = time.monotonic() + PATIENCE
    # The nominal model, without and with small faults, takes four; a candidate about five.
    while not fits.is_dir() or len(list(fits.glob('*.json'))) < 24:
        assert started.poll() is None, started.communicate()
        assert time.monotonic() < deadline
        time.sleep(0.02)
    started.send_signal(signal.SIGINT)
    out, err = started.communicate(timeout=PATIENCE)
    assert started.returncode == 0, err
    assert 'the best answer so far follows' in err
    assert 'interrupted after' in ' '.join(out.split())
    facts = json.loads((tmp_path / 'out' / 'diagnosis.json').read_text('utf-8'))
    assert facts['unfinished']['why'].startswith('interrupted after')
    assert facts['unfinished']['ranking'] or facts['causes']
    assert list(fits.glob('*.json'))
    page = (tmp_path / 'out' / 'report.html').read_text('utf-8')
    assert 'The best answer so far' in page


def test_a_fit_is_kept_once_and_recalled_as_it_was(delayed, tmp_path):
    model, records = delayed
    data_sets = prepare(model, records)
    with kept_fits.kept_in(tmp_path):
        with pytest.raises(IdentificationError):
            fit(model, [])
        assert not list(tmp_path.iterdir())
        once, again = fit(model, data_sets), fit(model, data_sets)
    assert len(list(tmp_path.iterdir())) == 1
    assert again.evaluations < once.evaluations
    for name in ('values', 'covariance', 'mse', 'count', 'cost', 'inflation', 'converged'):
        assert np.array_equal(getattr(once, name), getattr(again, name)), name
