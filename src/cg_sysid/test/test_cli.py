"""The command lines from end to end, and one line for everything that a user can get wrong."""

import io
import json
import shutil
import time

import pytest
import yaml
from rich.console import Console

from cg_description.paths import model_names
from cg_dynamics.model import Model
from cg_sysid import parallel
from cg_sysid.cli import common as cli
from cg_sysid.cli import diagnose as diagnose_cli
from cg_sysid.cli import identify as identify_cli
from cg_sysid.cli import report as report_cli
from cg_sysid.records.bags import read_bag, write_bag

EFFECTS = 'torque_bias,quadratic_friction'


@pytest.fixture(scope='module')
def result(bags, model_file, tmp_path_factory):
    out = tmp_path_factory.mktemp('result')
    code = diagnose_cli.main([
        '--model', str(model_file), '--out', str(out), '--effects', EFFECTS, '--rounds', '1',
        '--workers', '1', '--date', '2011-03-13T07:00:00Z', *map(str, bags),
    ])  # fmt: skip
    assert code == 0
    return out


def test_a_diagnosis_leaves_facts_page_and_model(result, model_file):
    facts = json.loads((result / 'diagnosis.json').read_text('utf-8'))
    assert facts['verdict'] == 'explained'
    assert facts['causes'][0]['label'] == 'torque_bias'
    gain = facts['gain']['hip_angle']
    assert gain['after'] < 0.3 * gain['before']
    model = Model.load(result / 'model.yaml')
    assert model.values['torque_bias.bias'] == pytest.approx(0.8, rel=0.1)
    assert model.provenance['parent'] == model_file.name
    assert model.provenance['causes'] == ['torque_bias']
    assert model.provenance['parent_sha256'] == facts['provenance']['model_sha256']
    assert (result / 'report.html').read_text('utf-8').startswith('<!DOCTYPE html>')


def test_the_report_is_drawn_again_from_the_results(result, tmp_path, capsys):
    copied = tmp_path / 'copied'
    shutil.copytree(result, copied)
    drawn = (copied / 'report.html').read_text('utf-8')
    (copied / 'report.html').unlink()
    assert report_cli.main([str(copied)]) == 0
    assert capsys.readouterr().out.strip() == str(copied / 'report.html')
    assert (copied / 'report.html').read_text('utf-8') == drawn


@pytest.mark.parametrize('method', ['gauss_newton', 'nelder_mead'])
def test_an_identification_reaches_the_values_of_the_machine(
    bags, result, method, tmp_path, capsys
):
    only = 'torque_bias.bias,viscous_friction.coefficient'
    code = identify_cli.main([
        '--model', str(result / 'model.yaml'), '--out', str(tmp_path), '--only', only,
        '--method', method, *map(str, bags),
    ])  # fmt: skip
    assert code == 0
    assert '2 parameters identified' in capsys.readouterr().out
    facts = json.loads((tmp_path / 'identification.json').read_text('utf-8'))
    found = {p['name']: p for p in facts['parameters'] if not p['fixed']}
    assert set(found) == set(only.split(','))
    # The other numbers of that model are identified themselves, to about a percent.
    assert found['torque_bias.bias']['identified'] == pytest.approx(0.8, rel=0.05)
    assert (found['torque_bias.bias']['sigma'] is None) == (method == 'nelder_mead')
    Model.load(tmp_path / 'model.yaml')
    assert (tmp_path / 'report.html').is_file()


def test_windows_and_records_to_hold_out(bags, model_file, tmp_path):
    code = diagnose_cli.main([
        '--model', str(model_file), '--out', str(tmp_path), '--effects', 'torque_bias',
        '--rounds', '1', '--workers', '1', '--window', '1.5', '--held', 'swing_2*', '--quiet',
        *map(str, bags),
    ])  # fmt: skip
    assert code == 0
    facts = json.loads((tmp_path / 'diagnosis.json').read_text('utf-8'))
    roles = {r['name']: r['role'] for r in facts['records']}
    # Two windows are fitted; the other recording can be followed whole, and judges so.
    assert sorted(roles.values()) == ['held', 'train', 'train']
    assert roles['swing_2'] == 'held'
    assert facts['windows']['how'] == 'chosen by you'
    assert facts['windows']['length_s'] == 1.5
    assert all(found['whole'] for found in facts['windows']['followed'].values())


def cut_off(bag, folder):
    """A copy of a bag that lost its second half."""
    copied = folder / 'cut_off'
    shutil.copytree(bag, copied)
    file = next(copied.glob('*.mcap'))
    file.write_bytes(file.read_bytes()[: file.stat().st_size // 2])
    return copied


def test_broken_recordings_are_never_fitted(bags, model_file, tmp_path, capsys):
    bad, out = cut_off(bags[0], tmp_path), tmp_path / 'out'
    code = diagnose_cli.main(['--model', str(model_file), '--out', str(out), str(bad)])
    assert code == 1
    said = capsys.readouterr()
    assert said.out.startswith('unusable')
    assert said.err.startswith(f'left out {bad}: ')
    assert said.err.count('\n') == 1
    facts = json.loads((out / 'diagnosis.json').read_text('utf-8'))
    assert facts['verdict'] == 'unusable'
    assert facts['unusable'][0]['source'] == str(bad)
    assert 'The recording is broken' in (out / 'report.html').read_text('utf-8')
    assert not (out / 'model.yaml').exists()


def test_a_diagnosis_goes_on_without_a_broken_recording(bags, model_file, tmp_path, capsys):
    bad, out = cut_off(bags[0], tmp_path), tmp_path / 'out'
    code = diagnose_cli.main([
        '--model', str(model_file), '--out', str(out), '--effects', EFFECTS, '--rounds', '1',
        '--workers', '1', *map(str, bags), str(bad),
    ])  # fmt: skip
    assert code == 0
    assert f'left out {bad}: ' in capsys.readouterr().err
    facts = json.loads((out / 'diagnosis.json').read_text('utf-8'))
    assert facts['verdict'] == 'explained'
    assert [u['name'] for u in facts['unusable']] == ['cut_off']
    assert 'Left out' in (out / 'report.html').read_text('utf-8')


@pytest.fixture
def places(bags, model_file, tmp_path):
    """Names that the table of bad inputs refers to."""
    (tmp_path / 'empty').mkdir()
    (tmp_path / 'file').write_text('text')
    (tmp_path / 'log.csv').write_text('t,q\n0,1\n')
    tree = yaml.safe_load(model_file.read_text('utf-8'))
    wrong = {
        'unit': lambda t: t['parameters']['c1'].update(unit='kg'),
        'range': lambda t: t['parameters']['total_mass'].update(value=-1.0),
        'form': lambda t: t.update(format='cg_model/9'),
    }
    for name, change in wrong.items():
        changed = yaml.safe_load(yaml.safe_dump(tree))
        change(changed)
        (tmp_path / f'{name}.yaml').write_text(yaml.safe_dump(changed))
    return {'tmp': tmp_path, 'm': model_file, 'a': bags[0], 'b': bags[1]}


BAD = {
    'no such bag': ('--model {m} --out {tmp}/o {tmp}/none', '{tmp}/none: no such bag'),
    'an empty directory': (
        '--model {m} --out {tmp}/o {tmp}/empty',
        '{tmp}/empty: not a bag; a directory with metadata.yaml and .mcap or .db3 files is needed',
    ),
    'a file of another kind': (
        '--model {m} --out {tmp}/o {tmp}/file {a}',
        '{tmp}/file: not a bag; a directory with metadata.yaml and .mcap or .db3 files is needed',
    ),
    'a log': (
        '--model {m} --out {tmp}/o {tmp}/log.csv {a}',
        '{tmp}/log.csv: a log, no bag; a mapping file says which column is which channel, then '
        '`cg import MAPPING.yaml {tmp} --out bags` makes bags of it '
        '(data.md, "Import of foreign logs")',
    ),
    'the same bag twice': ('--model {m} --out {tmp}/o {a} {a}', '{a}: given twice'),
    'one record only': (
        '--model {m} --out {tmp}/o {a}',
        '1 record: a diagnosis needs at least two, one to fit and one to judge; record another, '
        'or cut a long one into windows (--window SECONDS)',
    ),
    'a short window': (
        '--model {m} --out {tmp}/o --window 0.1 {a}',
        'window is 0.1 s; at least 0.5 s are needed',
    ),
    'no record held out': (
        '--model {m} --out {tmp}/o --held nothing* {a} {b}',
        "--held 'nothing*' matches no record; there are: swing_1, swing_2",
    ),
    'every record held out': (
        '--model {m} --out {tmp}/o --held swing* {a} {b}',
        "--held 'swing*' matches every record; there are: swing_1, swing_2",
    ),
    'no rounds': ('--model {m} --out {tmp}/o --rounds 0 {a} {b}',
                  '--rounds is 0; at least 1 is needed'),
    'no model': (
        '--model {tmp}/none.yaml --out {tmp}/o {a} {b}',
        "no model '{tmp}/none.yaml': there is no file {tmp}/none.yaml, and those that come along "
        'are called ' + ', '.join(model_names()),
    ),
    'a model with a wrong unit': (
        '--model {tmp}/unit.yaml --out {tmp}/o {a} {b}',
        "{tmp}/unit.yaml: parameters.c1.unit: 'kg' is not '1'",
    ),
    'a parameter out of range': (
        '--model {tmp}/range.yaml --out {tmp}/o {a} {b}',
        '{tmp}/range.yaml: parameters.total_mass = -1 kg is outside its range [0.05, 500] kg',
    ),
    'a model of another format': (
        '--model {tmp}/form.yaml --out {tmp}/o {a} {b}',
        "{tmp}/form.yaml: format: 'cg_model/9' is not cg_model/1",
    ),
    'a note that is not there': (
        '--model {m} --out {tmp}/o --note {tmp}/none.yaml {a} {b}',
        '{tmp}/none.yaml: cannot be read: No such file or directory',
    ),
    'a file in the way': (
        '--model {m} --out {tmp}/file --effects torque_bias --rounds 1 --workers 1 {a} {b}',
        '--out {tmp}/file: a file is in the way; name a directory',
    ),
}  # fmt: skip


@pytest.mark.parametrize('what', BAD)
def test_bad_input_gets_one_line(places, capsys, what):
    words, error = (text.format(**places) for text in BAD[what])
    assert diagnose_cli.main(words.split()) == 2
    assert capsys.readouterr().err == f'cg diagnose: error: {error}\n'


def test_an_unknown_effect_is_refused_with_the_library(places, capsys):
    words = '--model {m} --out {tmp}/o --effects torque_bias,gremlins {a} {b}'.format(**places)
    assert diagnose_cli.main(words.split()) == 2
    said = capsys.readouterr().err
    assert said.startswith("cg diagnose: error: --effects: no effect 'gremlins'; the library ")
    assert said.count('\n') == 1


def test_an_unknown_parameter_is_refused(places, capsys):
    words = '--model {m} --out {tmp}/o --only c9 {a}'.format(**places)
    assert identify_cli.main(words.split()) == 2
    said = capsys.readouterr().err
    assert said.startswith("cg identify: error: no parameter 'c9' to identify; there are: ")
    assert said.count('\n') == 1


def test_a_bag_of_another_machine_is_refused(places, capsys):
    record = read_bag(places['a'])
    note = {**record.note, 'mechanism': 'pendulum'}
    other = type(record)(
        'pendulum', record.stamp_ns, {'torque': record.inputs['hip_torque']},
        {'angle': record.outputs['hip_angle']}, 'pendulum', note=note,
    )  # fmt: skip
    bag = write_bag(places['tmp'] / 'pendulum', other)
    words = '--model {m} --out {tmp}/o {a} {b}'.format(**places).split()
    assert diagnose_cli.main([*words, str(bag)]) == 2
    assert capsys.readouterr().err == (
        f"cg diagnose: error: {bag}: recorded on a pendulum, but the model 'compass_gait_mit' is "
        'of a compass_gait\n'
    )


@pytest.mark.parametrize(
    ('name', 'error'),
    [
        ('none', '{tmp}/none: no such directory'),
        ('empty', '{tmp}/empty: neither diagnosis.json nor identification.json in it'),
    ],
)
def test_a_report_of_nothing_is_refused(places, capsys, name, error):
    assert report_cli.main([str(places['tmp'] / name)]) == 2
    assert capsys.readouterr().err == f'cg report: error: {error.format(**places)}\n'


def test_an_interrupt_ends_with_one_line(capsys):
    def work(_):
        raise KeyboardInterrupt

    assert cli.run('diagnose', work, None) == cli.INTERRUPTED
    assert capsys.readouterr().err == 'diagnose: interrupted\n'


def test_a_queue_of_work_can_be_dropped():
    parallel.stop()
    pool = parallel._local(1)
    waiting = [pool.submit(time.sleep, 30) for _ in range(3)]
    begun = time.monotonic()
    parallel.stop()
    pool.shutdown(wait=True)
    assert time.monotonic() - begun < 10
    assert waiting[-1].cancelled() or waiting[-1].exception() is not None


def test_the_gain_table_has_the_landings_too():
    gain = {'before': 0.0141, 'after': 0.0005, 'noise_floor': 0.0005, 'unit': 'rad', 'ratio': 28.0}
    phases = {**gain, 'before': 0.0005, 'ratio': 1.0}
    shown = io.StringIO()
    cli.print_gain(
        Console(file=shown, width=120),
        {'gain': {'imu_angle': phases}, 'landings': {'gain': {'imu_angle': gain}}},
    )
    lines = shown.getvalue().splitlines()
    assert any('imu_angle after touchdowns' in line and '28 x' in line for line in lines)
    assert any('1 x' in line and 'touchdowns' not in line for line in lines)
