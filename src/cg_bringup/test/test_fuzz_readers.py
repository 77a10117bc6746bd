"""Mutated files are taken or refused by one clear line: a small run of bench/fuzz_readers.py."""

import contextlib
import importlib.util
import sys
from pathlib import Path

import pytest

SCRIPT = Path(__file__).resolve().parents[3] / 'bench' / 'fuzz_readers.py'
if not SCRIPT.exists():
    pytest.skip('the mutations come with the sources of the workspace', allow_module_level=True)
spec = importlib.util.spec_from_file_location('fuzz_readers', SCRIPT)
fuzz = importlib.util.module_from_spec(spec)
sys.modules['fuzz_readers'] = fuzz  # dataclasses look their module up
spec.loader.exec_module(fuzz)
READERS = fuzz.readers()


@pytest.mark.parametrize('name', READERS)
def test_mutants_are_taken_or_refused(name, tmp_path):
    before = fuzz.memory_mb()
    fuzz.place_around(READERS[name], tmp_path)
    tally = fuzz.judge(name, READERS[name], range(400), tmp_path)
    assert tally.crashes == []
    assert tally.unclear == []
    assert 0 < tally.taken < tally.inputs
    assert tally.longest_s < fuzz.ALLOWED_S
    assert fuzz.memory_mb() - before < fuzz.ALLOWED_MB


@pytest.mark.parametrize('fuse', range(len(fuzz.FUSES)))
def test_bombs_do_not_go_off(fuse, tmp_path):
    text = fuzz.FUSES[fuse](30_000)
    for reader in ('model', 'trajectory', 'log (CSV)'):
        path = tmp_path / READERS[reader].name
        for seed in ('', READERS[reader].seeds[0].decode().replace('2', text, 1)):
            path.write_text(seed or text)
            began, before = fuzz.time.process_time(), fuzz.memory_mb()
            with contextlib.suppress(*fuzz.OURS):
                READERS[reader].read(path)
            assert fuzz.time.process_time() - began < fuzz.ALLOWED_S
            assert fuzz.memory_mb() - before < fuzz.ALLOWED_MB
