"""The page: self-contained, escaped, and drawn for every verdict."""

import base64
import copy
import re
from html.parser import HTMLParser

import numpy as np
import pytest

from cg_sysid.report import render
from cg_sysid.report.diagnosis_file import VERDICTS
from cg_sysid.report.markup import Markup, tag
from cg_sysid.report.signals import MISSING, STEPS, quantised, spectra
from cg_sysid.report.wording import headline, lead

HOSTILE = '</script><script>alert(1)</script><b a="'
VOID = {'br', 'col', 'hr', 'input', 'meta'}


class Outline(HTMLParser):
    """Elements that are opened and closed in order; remembers attributes."""

    def __init__(self):
        super().__init__()
        self.open, self.attributes, self.ids = [], [], []

    def handle_starttag(self, name, attributes):
        self.attributes += [(name, key, value) for key, value in attributes]
        self.ids += [value for key, value in attributes if key == 'id']
        if name not in VOID:
            self.open.append(name)

    def handle_endtag(self, name):
        assert self.open.pop() == name


def outline(page):
    parser = Outline()
    parser.feed(page)
    assert parser.open == []
    return parser


def with_verdict(facts, verdict):
    made = copy.deepcopy(facts)
    made['verdict'] = verdict
    if verdict not in ('explained', 'ambiguous'):
        made['causes'] = []
    if verdict == 'ambiguous':
        rival = {k: made['causes'][0][k] for k in ('name', 'label', 'at', 'place', 'description')}
        made['causes'][0]['rivals'] = [{**rival, 'label': 'ground_slope', 'name': 'ground_slope'}]
    if verdict == 'unusable':
        finding = {'code': 'stuck', 'severity': 'error', 'where': 'hip_angle',
                   'place': '1.0..2.0 s', 'message': 'does not change', 'start_s': 1.0,
                   'stop_s': 2.0}  # fmt: skip
        made |= {'gain': {}, 'ranking': [], 'records': [], 'remaining_error': {},
                 'noise_floor': {}}  # fmt: skip
        for source in made['sources']:
            source |= {'used': False, 'check': 'unusable', 'findings': [finding]}
        made['unusable'] = [
            {'name': s['name'], 'source': s['path'], 'where': 'hip_angle', 'place': '1.0..2.0 s',
             'reason': 'does not change'} for s in made['sources']
        ]  # fmt: skip
    if verdict == 'identified':
        made |= {'format': 'cg_identification/1', 'ranking': [], 'method': 'gauss_newton'}
    return made


@pytest.mark.parametrize('verdict', VERDICTS)
def test_every_verdict_is_drawn(facts, lines, verdict):
    page = render(with_verdict(facts, verdict), [] if verdict == 'unusable' else lines)
    parser = outline(page)
    assert len(parser.ids) == len(set(parser.ids))
    assert '<span class="verdict"' in page
    assert len(page) < 3_000_000


def test_what_is_not_determined_is_said_beside_the_cause(facts, lines):
    said = 'These recordings do not determine bias: what acts like this'
    assert said not in render(facts, lines)
    made = with_verdict(facts, 'explained')
    made['causes'][0]['undetermined'] = ['bias']
    assert said in render(made, lines)
    made['causes'][0] |= {'undetermined': [], 'at_edge': ['bias']}
    assert 'The fit drove bias to the edge of what was tried: what acts like this' in render(
        made, lines
    )


def test_causes_that_explain_little_are_not_called_the_cause(facts, lines):
    said = 'takes less than half of the error, and may only stand in'
    assert said not in render(with_verdict(facts, 'unexplained'), lines)
    made = with_verdict(facts, 'explained')
    assert said not in render(made, lines)
    made['verdict'] = 'unexplained'
    made['provenance']['options'] = {'effects': 'torque_bias,payload@outer'}
    page = render(made, lines)
    assert said in page
    assert 'no effect tried (torque bias or payload (outer)) explains' in page


def test_a_learned_term_of_little_makes_no_headline(facts):
    made = with_verdict(facts, 'unexplained')
    made['unmodelled'] = {'what': 'a torque at the hip', 'explained': 0.96}
    assert headline(made) == 'The simulation lacks a torque at the hip'
    assert 'A learned function describes it.' in lead(made)
    made['unmodelled']['explained'] = 0.044
    assert headline(made).startswith('There is an error in')
    assert 'A learned function describes 4.4 % of it.' in lead(made)


def test_the_page_fetches_nothing(facts, lines):
    page = render(facts, lines)
    parser = outline(page)
    # The name space of SVG is a name, not an address that is fetched.
    rest = page.replace('http://www.w3.org/2000/svg', '')
    assert not re.search(r'https?:|//[a-z]+\.|@import|url\((?!#)', rest.replace("'url(#'", ''))
    outside = [a for a in parser.attributes if a[1] in ('src', 'href') and a[2][:1] != '#']
    assert outside == []


def test_names_cannot_break_the_page(facts, lines):
    made = copy.deepcopy(facts)
    made['model']['name'] = HOSTILE
    made['records'][0]['name'] = HOSTILE
    made['sources'][0]['name'] = made['sources'][0]['path'] = HOSTILE
    made['causes'][0]['label'] = made['causes'][0]['name'] = HOSTILE
    made['findings'] = [HOSTILE]
    made['provenance']['command'] = [HOSTILE]
    object.__setattr__(hostile := copy.copy(lines[0]), 'name', HOSTILE)
    page = render(made, [hostile, *lines[1:]])
    outline(page)
    assert 'alert(1)</script>' not in page
    assert page.count('<script') == 2


def test_text_is_escaped_and_markup_is_not():
    inner = tag('b', 'a < b')
    assert tag('p', inner, ['x & y', None], class_='"') == (
        '<p class="&quot;"><b>a &lt; b</b>x &amp; y</p>'
    )
    assert isinstance(inner, Markup)
    assert tag('input', type='checkbox', checked=True, id=None) == (
        '<input type="checkbox" checked>'
    )


def test_numbers_of_the_gain_are_on_the_page(facts, lines):
    page = render(facts, lines)
    assert 'The simulation lacks torque bias' in page
    assert '\u00d7 smaller' in page


def test_signals_lose_no_more_than_half_a_step():
    values = np.array([-1.0, np.nan, 0.123456, 3.0])
    packed = quantised(values)
    steps = np.frombuffer(base64.b64decode(packed['b']), '<u2')
    assert steps[1] == MISSING
    back = packed['lo'] + packed['span'] * steps / STEPS
    np.testing.assert_allclose(back[[0, 2, 3]], values[[0, 2, 3]], atol=0.5 * 4.0 / STEPS)
    assert quantised(np.array([np.nan])) is None


def test_the_spectrum_of_white_noise_lies_on_the_floor(lines):
    sigma, line = 0.01, lines[0]
    rng = np.random.default_rng(0)
    time = np.arange(20000) * 0.002
    noise = sigma * rng.standard_normal((20000, 3))
    white = copy.copy(line)
    for name, values in {'time': time, 'measured': np.zeros((20000, 3)), 'before': noise,
                         'after': noise}.items():  # fmt: skip
        object.__setattr__(white, name, values)
    found = spectra([white], 0, sigma)
    # Some 19 segments of a chi-square with two degrees of freedom, averaged over frequency.
    assert np.mean(found['after'][20:]) == pytest.approx(found['floor'], rel=0.1)
