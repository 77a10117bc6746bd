"""Progress where it is piped: whole lines, in time, whatever holds the work up."""

import io
import re
import time

import numpy as np
import pytest

from cg_dynamics.model import Model
from cg_dynamics.rig import Setup
from cg_dynamics.rollout import compiler as c_compiler
from cg_sysid import parallel, progress
from cg_sysid.diagnosis.diagnose import Options, diagnose
from cg_sysid.experiments.rehearsal import rehearse
from cg_sysid.identification.data_set import prepare
from cg_sysid.identification.identify import fit
from cg_sysid.identification.nelder_mead import nelder_mead
from cg_sysid.progress import EVERY, Bars, Lines, Stage

TICK = 0.05  # s


def waited_for(stream, count):
    """The lines of a stream once there are so many; at most 10 s later."""
    deadline = time.monotonic() + 10.0
    while stream.getvalue().count('\n') < count and time.monotonic() < deadline:
        time.sleep(TICK / 5)
    return stream.getvalue().splitlines()


def test_a_line_says_what_is_done_what_is_left_and_what_leads():
    stage = Stage('effects on top of nominal', 12, 34, 'nominal + backlash, off by 1.3 times')
    assert str(stage) == (
        'effects on top of nominal: 12 of 34 done, 22 left; '
        'best so far: nominal + backlash, off by 1.3 times'
    )
    assert str(Stage('reading', 3, 3)) == 'reading: done; working out what comes next'


def test_lines_come_while_one_piece_holds_everything_up():
    """Nobody reports anything, and still there is a line each time."""
    assert EVERY <= 10.0
    stream = io.StringIO()
    lines = Lines('cg diagnose', TICK, stream)
    lines.stage = Stage('fitting the nominal model', 0, 1)
    lines.start()
    said = waited_for(stream, 3)
    lines.stop()
    assert len(said) >= 3
    for line in said:
        assert re.fullmatch(
            r'cg diagnose: \d+ s: fitting the nominal model: 0 of 1 done, 1 left', line
        )
    assert stream.getvalue().count('\n') == len(stream.getvalue().splitlines())


def test_a_compiler_at_work_is_named(tmp_path, monkeypatch):
    """A stand-in for the compiler holds the build up until the line is there."""
    monkeypatch.setenv('CG_CACHE', str(tmp_path / 'cache'))
    gate = tmp_path / 'gate'
    compiler = tmp_path / 'cc'
    compiler.write_text(
        f'#!/bin/sh\nwhile [ ! -e {gate} ]; do sleep 0.02; done\n'
        'while [ "$1" != -o ]; do shift; done; : > "$2"\n'
    )
    compiler.chmod(0o755)
    monkeypatch.setattr(c_compiler, 'compiler', lambda: str(compiler))

    class Opens(io.StringIO):
        def write(self, text):
            if 'the C compiler has worked for' in text:
                gate.touch()
            return super().write(text)

    stream = Opens()
    lines = Lines('cg identify', TICK, stream)
    lines.start()
    c_compiler.build('int f;', tmp_path / 'cache' / 'f.so')
    lines.stop()
    assert 'the C compiler has worked for' in stream.getvalue()
    assert c_compiler.seconds_under_way(parallel.processes()) == 0.0


def test_bars_speak_in_lines_where_nobody_watches(monkeypatch, capsys):
    monkeypatch.setattr(progress, 'EVERY', TICK)
    with Bars('cg import') as bars:
        bars('reading logs', 1, 4)
        time.sleep(6 * TICK)
    said = capsys.readouterr().err
    assert 'cg import: 0 s: reading logs: 1 of 4 done, 3 left\n' in said
    with Bars('cg import', quiet=True) as bars:
        bars('reading logs', 1, 4)
        time.sleep(3 * TICK)
    assert capsys.readouterr().err == ''


@pytest.mark.parametrize('method', [fit, nelder_mead])
def test_an_identification_says_how_far_it_is_and_how_good(method, model_file):
    model = Model.load(model_file)
    only = ['coulomb_friction.torque']
    record = rehearse(
        'swing', model, Setup(fixture='inner_fixed'), [0.2, 1.0], [lambda t: 3.0], 2.0, 0.004
    )
    heard = []
    method(model, prepare(model, [record]), only, progress=lambda *said: heard.append(said))
    assert heard
    assert all(0 <= done <= total for _, done, total, _ in heard)
    assert [done for _, done, _, _ in heard] == sorted(done for _, done, _, _ in heard)
    assert re.fullmatch(r'off by (1|0\.\d+|1\.\d+) times the noise', heard[-1][3])


def test_a_diagnosis_names_its_best_candidate(model_file):
    """First the nominal model, then what explains more; only the last can be the delay."""
    model = Model.load(model_file)
    robot = model.with_effect('sensor_delay', delay=0.012)
    records = [
        rehearse(
            f'swing_{k}', robot, Setup(fixture='inner_fixed'), [0.2, 1.0],
            [lambda t, k=k: 6.0 * np.sin(2 * np.pi * (0.6 + 0.3 * k) * t)], 2.0, 0.002, k,
        )
        for k in range(2)
    ]  # fmt: skip
    heard = []
    diagnose(
        model, records, Options(effects=('sensor_delay',), rounds=1, workers=0),
        lambda *said: heard.append(said),
    )  # fmt: skip
    bests = [best for _, _, _, best in heard]
    assert bests[0] == ''
    assert bests[-1].startswith('nominal + sensor_delay, off by ')
    assert all(done <= total for _, done, total, _ in heard)
