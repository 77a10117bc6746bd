"""What the docs print runs, and what they point to is there."""

import re
import subprocess
import sys
from pathlib import Path

import pytest

import cg_sysid
from cg_description.paths import model_path
from cg_dynamics.model import Model
from cg_sysid import rehearse, write_bag
from cg_sysid.experiments.catalogue import load_experiment
from cg_sysid.experiments.excitation import ExcitationSettings, make_signal
from cg_sysid.search import settings

ROOT = Path(__file__).resolve().parents[3]
PAGES = sorted([*(ROOT / 'docs').glob('**/*.md'), ROOT / 'README.md', ROOT / 'CONTRIBUTING.md'])
NAMES = ('run_1', 'run_2', 'run_07')  # of the bags that the blocks read
PYTHON = [
    pytest.param(block, id=f'{page.name}-{k}')
    for page in PAGES
    if page.name not in ('README.md', 'pendulum.md', 'arm.md')  # as files: test_readme.py, below
    for k, block in enumerate(re.findall(r'```python\n(.*?)```', page.read_text('utf-8'), re.S))
]

pytestmark = pytest.mark.skipif(not (ROOT / 'docs').is_dir(), reason='no docs around')


@pytest.fixture(scope='module')
def bags(tmp_path_factory):
    """A folder with the recordings that the pages speak of."""
    folder = tmp_path_factory.mktemp('docs')
    machine = Model.load(model_path('compass_gait_mit')).with_effect('sensor_delay', delay=0.012)
    e = load_experiment('swing_inner_fixed')
    for seed, name in enumerate(NAMES, 1):
        signal = make_signal(ExcitationSettings(**e.excitation, duration=3.0, seed=seed))
        made = rehearse(name, machine, e.setup, e.initial_state, [signal], 3.0, seed=seed)
        write_bag(folder / 'bags' / name, made)
    return folder


@pytest.mark.slow
@pytest.mark.parametrize('block', PYTHON)
def test_python_of_the_docs_runs_as_printed(block, bags, monkeypatch):
    monkeypatch.chdir(bags)
    exec(compile(block, 'block of the docs', 'exec'), {'__name__': '__main__'})


def _anchors(page):
    """Anchors of the headings of a page, as GitHub makes them."""
    heads = re.findall(r'^#+ (.*)$', page.read_text('utf-8'), re.M)
    kept = [re.sub(r'[^\w\- ]', '', re.sub(r'[`*]', '', head.lower())) for head in heads]
    return {head.strip().replace(' ', '-') for head in kept}


@pytest.mark.parametrize('page', PAGES, ids=lambda page: page.name)
def test_links_lead_somewhere(page):
    text = re.sub(r'```.*?```', '', page.read_text('utf-8'), flags=re.S)
    for link in re.findall(r'\]\(([^)\s]+)\)', text):
        if link.startswith(('http://', 'https://', 'mailto:')):
            continue
        place, _, anchor = link.partition('#')
        target = (page.parent / place).resolve() if place else page
        assert target.exists(), f'{page.name}: {link}'
        if anchor and target.suffix == '.md':
            assert anchor in _anchors(target), f'{page.name}: {link}'


def test_api_page_lists_what_is_public():
    found = re.findall(r'^::: [\w.]+\.(\w+)$', (ROOT / 'docs/reference/api.md').read_text(), re.M)
    assert sorted(found) == sorted(getattr(cg_sysid, n).__name__ for n in cg_sysid.__all__)


def test_every_page_has_a_place_on_the_site():
    site = (ROOT / 'mkdocs.yml').read_text('utf-8')
    for page in (ROOT / 'docs').glob('**/*.md'):
        assert f'- {page.relative_to(ROOT / "docs").as_posix()}\n' in site, page


@pytest.mark.slow
@pytest.mark.parametrize(
    ('page', 'answer'),
    [
        ('pendulum', 'The simulation lacks stribeck_friction (torque = 0.0199'),
        pytest.param(
            'arm', 'The simulation lacks payload@tool0 (mass = 0.2', marks=pytest.mark.evidence
        ),
    ],
)
def test_a_tutorial_runs_as_printed(page, answer, tmp_path):
    """From a CSV, or from a URDF and bags of a robot in MuJoCo, to a diagnosis; no ROS."""
    if page == 'arm':
        pytest.importorskip('mujoco', reason='MuJoCo is not installed')
    for name in ('cg', 'src'):
        (tmp_path / name).symlink_to(ROOT / name)
    done = subprocess.run(
        [sys.executable, ROOT / 'tools/try_readme.py', '--within', tmp_path, '--page',
         f'docs/tutorials/{page}.md'],
        stdin=subprocess.DEVNULL, capture_output=True, text=True, timeout=300, check=False,
    )  # fmt: skip
    said = ' '.join(done.stdout.split())
    assert done.returncode == 0, f'{done.stdout}\n{done.stderr}'
    assert answer in said


def test_thresholds_that_the_docs_state_are_those_of_the_search():
    text = (ROOT / 'docs/explanation/diagnosis.md').read_text('utf-8')
    stated = re.findall(r'`([a-z]+)\.(\w+)` ([\d.]+)', text)
    assert len(stated) > 15
    for stage, name, value in stated:
        found = getattr(getattr(settings, stage.upper()), name)
        first = found[0] if isinstance(found, tuple) else found
        assert first == pytest.approx(float(value)), f'{stage}.{name}'


def test_the_public_face_is_what_the_docs_list():
    text = (ROOT / 'docs/reference/python.md').read_text('utf-8').partition('Places of earlier')[0]
    for name in cg_sysid.__all__:
        assert getattr(cg_sysid, name) is not None
        assert re.search(rf'`{name}\b|\b{name}\b', text), name
