"""The page by keyboard and screen reader: landmarks, headings, tables, names, contrast."""

import itertools
import re
from html.parser import HTMLParser
from importlib import resources

import pytest
from test_report import VOID, with_verdict

from cg_sysid.report import render
from cg_sysid.report.diagnosis_file import VERDICTS
from cg_sysid.report.tried import DEEPEST

LEGIBLE = 4.5  # contrast of text, WCAG 2.2, 1.4.3
VISIBLE = 3.0  # contrast of lines and marks, WCAG 2.2, 1.4.11
TONES = ('good', 'warn', 'bad', 'odd')


class Element:
    """One element: its name, attributes, what it is in, and its text."""

    def __init__(self, name, attributes, parents):
        self.name, self.parents, self.text = name, parents, ''
        self.attributes = dict(attributes)

    def within(self, name):
        return any(parent.name == name for parent in self.parents)


class Page(HTMLParser):
    """All elements of a page in order."""

    def __init__(self, text):
        super().__init__()
        self.elements, self.open = [], []
        self.feed(text)

    def handle_starttag(self, name, attributes):
        self.elements.append(Element(name, attributes, tuple(self.open)))
        if name not in VOID:
            self.open.append(self.elements[-1])

    def handle_endtag(self, name):
        self.open.pop()

    def handle_data(self, data):
        for element in self.open:
            element.text += data

    def all(self, *names):
        return [element for element in self.elements if element.name in names]


@pytest.fixture(params=VERDICTS)
def page(request, facts, lines):
    verdict = request.param
    return Page(render(with_verdict(facts, verdict), [] if verdict == 'unusable' else lines))


def test_headings_skip_no_level(page):
    levels = [int(h.name[1]) for h in page.all('h1', 'h2', 'h3', 'h4', 'h5', 'h6')]
    assert levels[0] == 1
    assert levels.count(1) == 1
    assert all(after <= before + 1 for before, after in itertools.pairwise(levels))


def test_landmarks_and_the_way_to_the_answer(page):
    assert len(page.all('main')) == len(page.all('footer')) == 1
    (nav,) = page.all('nav')
    assert nav.attributes['aria-label']
    titles = {e.attributes['id']: e.text for e in page.all('h1', 'h2') if 'id' in e.attributes}
    assert all(titles[s.attributes['aria-labelledby']] for s in page.all('section'))
    ids = {e.attributes['id'] for e in page.elements if 'id' in e.attributes}
    links = [a.attributes['href'][1:] for a in page.all('a')]
    assert links[0] == 'answer'  # the first stop of the tab key
    assert set(links) <= ids


def test_the_tab_key_goes_in_the_order_of_the_page(page):
    stops = [e.attributes['tabindex'] for e in page.elements if 'tabindex' in e.attributes]
    assert set(stops) <= {'0', '-1'}
    # What scrolls sideways can be reached and has a name.
    wide = [e for e in page.all('div') if e.attributes.get('class') == 'scroll']
    assert all(e.attributes.get('tabindex') == '0' for e in wide)
    assert all(e.attributes.get('role') and e.attributes.get('aria-label') for e in wide)


def test_tables_say_what_their_cells_are_about(page):
    headers = page.all('th')
    assert all(th.attributes.get('scope') in ('row', 'col') and th.text for th in headers)
    for table in page.all('table'):
        inside = [th.attributes['scope'] for th in headers if table in th.parents]
        assert 'col' in inside


def test_what_is_drawn_or_pressed_has_a_name(page):
    drawn = [e for e in page.elements if e.attributes.get('role') == 'img']
    assert all(e.attributes.get('aria-label') for e in drawn)
    assert all(e.attributes.get('role') == 'img' for e in page.all('svg'))
    # An arrow is no name.
    pressed = page.all('button')
    assert all(e.attributes.get('aria-label') or re.search(r'\w', e.text) for e in pressed)
    assert all(e.attributes.get('aria-label') or e.within('label') for e in page.all('select'))
    assert all(e.within('label') for e in page.all('input'))
    groups = [e for e in page.elements if e.attributes.get('role') == 'group']
    assert all(e.attributes.get('aria-label') for e in groups)


def test_every_plot_that_is_drawn_by_the_script_gets_a_title():
    script = resources.files('cg_sysid.report').joinpath('plots.js').read_text(encoding='utf-8')
    assert "'aria-label': spec.title" in script
    calls = script.split('chart(host')[2:]  # the first is its definition
    assert len(calls) == 6
    assert all('title: ' in call[:200] for call in calls)


def test_every_torque_of_a_robot_has_a_line_and_a_key():
    report = resources.files('cg_sysid.report')
    script, style = (report.joinpath(n).read_text('utf-8') for n in ('plots.js', 'page.css'))
    colours = int(re.search(r'COLOURS = (\d+)', script)[1])
    drawn = [re.search(rf'\.line\.torque{i} {{ stroke: (\S+); }}', style) for i in range(colours)]
    assert len({found[1] for found in drawn}) == colours
    assert all(f'.legend .k-torque{i} ' in style for i in range(colours))


def _colours(style):
    """Variables of the page by day and by night: name -> (red, green, blue), each 0 to 1."""
    blocks = re.findall(r':root \{(.*?)\}', style, re.DOTALL)
    return [
        {name: tuple(int(value[k : k + 2], 16) / 255 for k in (0, 2, 4))
         for name, value in re.findall(r'--(\w+): #(\w{6})', block)}
        for block in blocks
    ]  # fmt: skip


def _contrast(a, b):
    """Ratio of relative luminances (WCAG 2.2)."""

    def luminance(colour):
        linear = [c / 12.92 if c <= 0.04045 else ((c + 0.055) / 1.055) ** 2.4 for c in colour]
        return 0.2126 * linear[0] + 0.7152 * linear[1] + 0.0722 * linear[2]

    light, dark = sorted((luminance(a), luminance(b)), reverse=True)
    return (light + 0.05) / (dark + 0.05)


def _mixed(a, b, share):
    return tuple(share * x + (1 - share) * y for x, y in zip(a, b, strict=True))


@pytest.mark.parametrize('scheme', [0, 1, 2], ids=['day', 'night', 'print'])
def test_text_and_marks_stand_out(scheme):
    style = resources.files('cg_sysid.report').joinpath('page.css').read_text(encoding='utf-8')
    colours = _colours(style)[scheme]
    paper, panel, ink = (colours[name] for name in ('paper', 'panel', 'ink'))
    for name in ('ink', 'soft', *TONES):
        for ground in (paper, panel):
            assert _contrast(colours[name], ground) >= LEGIBLE, name
    for name in ('before', 'after', 'noise', 'measured', 'torque'):
        for ground in (paper, panel):
            assert _contrast(colours[name], ground) >= VISIBLE, name
    for name in ('before', 'after'):
        assert _contrast(ink, _mixed(colours[name], panel, DEEPEST)) >= LEGIBLE, name
    assert ':focus-visible' in style
