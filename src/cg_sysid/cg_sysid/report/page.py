"""The page as a whole: order of its parts, style, scripts and data, all in one file."""

import json
from collections.abc import Sequence
from importlib import resources
from pathlib import Path

from cg_description.model_file import write_atomically
from cg_sysid.checks.faults import FaultSignal
from cg_sysid.report import answer, data, fits, tried
from cg_sysid.report.curves import Curve, load
from cg_sysid.report.diagnosis_file import FILE_NAMES, Facts, read_facts
from cg_sysid.report.markup import Markup, tag
from cg_sysid.report.signals import payload
from cg_sysid.report.wording import headline

FILE_NAME = 'report.html'
# Nothing may be fetched, whatever a name or note contains.
POLICY = "default-src 'none'; style-src 'unsafe-inline'; script-src 'unsafe-inline'; img-src data:"


def write_report(directory: str | Path, out: str | Path | None = None) -> Path:
    """Draw the report of the results in a directory.

    Args:
        directory: Holds diagnosis.json or identification.json and curves.npz.
        out: Page to write; report.html in the directory by default.

    Raises:
        ValueError: The results are missing or of another format.
    """
    facts = read_facts(directory)
    try:
        page = render(facts, *load(directory))
    except KeyError as error:
        raise ValueError(
            f'{directory}: the results lack {error}; were they written by another version?'
        ) from error
    path = Path(out) if out else Path(directory) / FILE_NAME
    write_atomically(path, page)
    return path


def render(facts: Facts, curves: Sequence[Curve], faults: Sequence[FaultSignal] = ()) -> str:
    """The page as text.

    Args:
        facts: As facts.py builds them.
        curves: Measured and simulated signals, those that judge first; may be empty.
        faults: Signals around the faults of broken recordings.
    """
    drawn = payload(facts, curves, faults)
    sections = [
        section
        for section in (
            ('answer', 'Answer', answer.answer(facts, drawn)),
            ('signals', 'Measured and simulated', fits.viewer(facts, drawn)),
            ('residuals', 'What is left', fits.residuals(facts, drawn)),
            ('tried', 'What was tried', tried.rounds(facts)),
            ('parameters', 'Parameters', tried.parameters(facts)),
            ('data', 'Recordings', data.recordings(facts)),
            ('origin', 'Provenance', data.origin(facts)),
        )
        if section[2] is not None
    ]
    title = f'{headline(facts)} \u2013 {facts["model"]["name"]}'
    body = [
        tag('a', 'To the answer', href='#answer', class_='skip'),
        tag('nav', tag('div',
            tag('b', facts['model']['name']),
            [tag('a', name, href=f'#{key}') for key, name, _ in sections],
            tag('span', _day(facts)),
        ), class_='bar', aria_label='parts of the page'),
        tag('main', [content for _, _, content in sections]),
        tag('footer', f'Drawn from {FILE_NAMES[facts["format"]]} and curves.npz. '
            'Self-contained: works offline.'),
    ]  # fmt: skip
    head = [
        tag('meta', charset='utf-8'),
        tag('meta', name='viewport', content='width=device-width, initial-scale=1'),
        tag('meta', http_equiv='Content-Security-Policy', content=POLICY),
        tag('title', title),
        tag('style', Markup(_file('page.css'))),
    ]
    scripts = [
        tag('noscript', tag('p', 'The plots need JavaScript, which is part of this page.')),
        tag('script', Markup(_embedded(drawn)), type='application/json', id='curves'),
        tag('script', Markup(_file('plots.js'))),
    ]
    document = tag('html', tag('head', head), tag('body', body, scripts), lang='en')
    return f'<!DOCTYPE html>\n{document}\n'


def _file(name: str) -> str:
    return resources.files(__package__).joinpath(name).read_text(encoding='utf-8')


def _embedded(drawn: Facts) -> str:
    # A '<' inside a name would end the script element.
    text = json.dumps(drawn, separators=(',', ':'), allow_nan=False)
    return text.replace('<', '\\u003c').replace('\u2028', '\\u2028')


def _day(facts: Facts) -> str:
    return str(facts['provenance'].get('created', ''))[:10]
