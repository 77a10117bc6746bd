"""Third part of the page: every candidate that was tried, and the parameters."""

import math

from cg_sysid.report.markup import Markup, column, row, tag, wide
from cg_sysid.report.wording import Facts, parameter_words
from cg_sysid.text import effect_name, measured, number, plain_unit

SHOWN = 6  # candidates of a round before the rest is folded away
DEEPEST = 0.45  # share of colour in a cell of the heat map
BELIEF_SPAN = 4.0  # tolerances on either side in the little plots


def rounds(facts: Facts) -> Markup | None:
    """The ranking of each round."""
    if not facts['ranking']:
        return None
    causes = {c['label']: {r['label'] for r in c['rivals']} | set(c['places'])
              for c in facts['causes']}  # fmt: skip
    return tag('section',
        tag('h2', 'What was tried', id='tried-title'),
        tag('p', 'Every effect of the library was fitted on top of the model, from several '
            'starts, to the first seconds and, where promising, to whole records. Evidence '
            'counts how strongly all records speak for it, after paying for its parameters; '
            'the error is judged on records held out.', class_='soft'),
        [_round(k, r, causes) for k, r in enumerate(facts['ranking'], start=1)],
        id='tried', aria_labelledby='tried-title',
    )  # fmt: skip


def _count(candidates: list[Facts]) -> str:
    return f'{len(candidates)} candidate{"s" if len(candidates) != 1 else ""}'


def _round(k: int, r: Facts, causes: dict[str, set[str]]) -> Markup:
    candidates = r['candidates']
    taken = r['accepted']
    outcome = f'taken: {effect_name(taken)}' if taken else 'nothing earned its place'
    base = ' + '.join(effect_name(part) for part in r['base'].split(' + '))
    strongest = max([c['evidence_nats'] or 0.0 for c in candidates], default=0.0)
    rivals = causes.get(taken, set()) if taken else set()
    table = _ranking(candidates[:SHOWN], taken, rivals, strongest)
    rest = candidates[SHOWN:]
    return tag('div',
        tag('details',
            tag('summary', f'Round {k}: on top of {base} ',
                tag('span', f'\u2013 {_count(candidates)}, {outcome}', class_='soft')),
            wide(f'Candidates of round {k}', table),
            tag('details', tag('summary', f'{len(rest)} more candidates'),
                wide(f'More candidates of round {k}', _ranking(rest, taken, rivals, strongest)))
            if rest else None,
            tag('p', 'Not fitted to whole records: ',
                ', '.join(effect_name(label) for label in r['set_aside']), class_='small')
            if r['set_aside'] else None,
            open=k == 1),
        class_='round',
    )  # fmt: skip


def _ranking(
    candidates: list[Facts], taken: str | None, rivals: set[str], strongest: float
) -> Markup:
    head = tag('tr', column('effect'), column('evidence in nats', class_='num'),
               column('held-out error, in noise', class_='num'),
               column('significance', class_='num'),
               column('outcome'))  # fmt: skip
    columns = tag('colgroup', [tag('col', style=f'width:{w}%') for w in (32, 18, 14, 10, 26)])
    rows = [_candidate(c, taken, rivals, strongest) for c in candidates]
    return tag('table', columns, tag('thead', head), tag('tbody', rows), class_='ranking')


def _candidate(c: Facts, taken: str | None, rivals: set[str], strongest: float) -> Markup:
    if c['label'] == taken:
        kind, outcome = 'taken', tag('span', 'taken', class_='pill taken')
    elif c['label'] in rivals:
        kind, outcome = 'rival-row', tag('span', 'explains it as well', class_='pill warning')
    elif c['reason']:
        parts = [tag('div', part) for part in c['reason'].split('; ')]
        kind, outcome = 'rejected', tag('div', parts, class_='small')
    else:
        kind, outcome = '', tag('span', 'helps, but less', class_='soft small')
    return tag('tr',
        row(tag('b', effect_name(c['label'])),
            tag('small', ', '.join(parameter_words(c['parameters'])))),
        tag('td', number(c['evidence_nats']), _meter(c['evidence_nats'], strongest),
            class_='num'),
        tag('td', _fall(c), class_='num'),
        tag('td', f'{number(c["significance"], 2)} \u03c3', class_='num'),
        tag('td', outcome),
        class_=kind or None,
    )  # fmt: skip


def _fall(c: Facts) -> str:
    """RMS error on held-out records in noise standard deviations, before and after."""
    after, gain = c['chi2_per_sample']['held'], c['held_gain']
    if after is None or gain is None:
        return '\u2013'
    # Both are squared errors; the base of the round is not stored apart.
    before = after / (1 - gain) if gain < 1 else None
    start = number(math.sqrt(before), 3) if before is not None else '\u2013'
    return f'{start} \u2192 {number(math.sqrt(after), 3)}'


def _meter(value: float | None, strongest: float) -> Markup:
    # Square root: a rival at half the evidence must still be seen beside a winner of thousands.
    share = math.sqrt(max(value or 0.0, 0.0) / strongest) if strongest > 0 else 0.0
    return tag(
        'span',
        tag('i', style=f'width:{100 * min(share, 1.0):.0f}%'),
        class_='meter',
        aria_hidden='true',
    )


def parameters(facts: Facts) -> Markup | None:
    """Nominal and identified values, and how they go together."""
    moved = [p for p in facts['parameters'] if not p['fixed']]
    fixed = [p for p in facts['parameters'] if p['fixed']]
    if facts['verdict'] == 'unusable' or not (moved or fixed):
        return None
    head = tag(
        'tr',
        column('parameter'),
        column('model file', class_='num'),
        column('identified', class_='num'),
        column('unit'),
        column('change in tolerances'),
        column('known from data', class_='num'),
    )
    table = wide(
        'Identified parameters',
        tag('table', tag('thead', head), tag('tbody', [_row(p) for p in moved])),
    )
    from_all = (facts.get('delivered') or {}).get('from_all')
    return tag('section',
        tag('h2', 'Parameters', id='parameters-title'),
        tag('p', 'The grey band is what the model file believes, one tolerance either way; the '
            'dot is the identified value, the bar its 95 % interval. The last column says how '
            'much of the certainty comes from the recordings rather than from the file.',
            class_='soft') if moved else None,
        tag('p', 'Errors and evidence are those of these values, which have not seen what judges '
            'them. Those of model.yaml come from a last fit to all recordings.',
            class_='soft') if moved and from_all else None,
        table if moved else None,
        tag('details', tag('summary', f'{len(fixed)} held fixed'),
            wide('Fixed parameters', _fixed_table(fixed)))
        if fixed else None,
        correlation(facts),
        id='parameters', aria_labelledby='parameters-title',
    )  # fmt: skip


def _row(p: Facts) -> Markup:
    share = p['information']
    added = [' ', tag('span', 'added', class_='pill ok')] if p['added'] else None
    if p['sigma'] is None:
        value = number(p['identified'], 5)
    else:
        value = measured(p['identified'], p['sigma'])
    nominal = measured(p['nominal'], p['tolerance'])
    return tag('tr',
        row(tag('b', p['name']), added, tag('small', p['description'])),
        tag('td', nominal, class_='num'),
        tag('td', value, class_='num'),
        tag('td', plain_unit(p['unit'])),
        tag('td', _belief(p)),
        tag('td', '\u2013' if share is None else f'{100 * share:.0f} %', class_='num'),
    )  # fmt: skip


def _fixed_table(fixed: list[Facts]) -> Markup:
    head = tag('tr', column('parameter'), column('value', class_='num'), column('unit'),
               column('source'))  # fmt: skip
    return tag('table', tag('thead', head), tag('tbody', [_fixed(p) for p in fixed]))


def _fixed(p: Facts) -> Markup:
    return tag('tr', row(p['name'], tag('small', p['description'])),
               tag('td', number(p['nominal'], 5), class_='num'),
               tag('td', plain_unit(p['unit'])),
               tag('td', p['source'], class_='soft'))  # fmt: skip


def _belief(p: Facts) -> Markup:
    moved, tolerance = p['moved_tolerances'], p['tolerance']
    if moved is None or not tolerance:
        return tag('span', '\u2013' if not p['added'] else 'not in the file', class_='soft small')

    def at(tolerances: float) -> float:
        return 50 + 50 * min(max(tolerances / BELIEF_SPAN, -1.0), 1.0)

    half = 1.96 * (p['sigma'] or 0.0) / tolerance
    a, b = at(moved - half), at(moved + half)
    out = abs(moved) > BELIEF_SPAN
    dot = at(moved) if not out else (98.0 if moved > 0 else 2.0)
    band = f'left:{at(-1):.1f}%;width:{at(1) - at(-1):.1f}%'
    return tag('div',
        tag('i', class_='about', style=band), tag('i', class_='centre', style='left:50%'),
        tag('i', class_='whisker', style=f'left:{a:.1f}%;width:{b - a:.1f}%'),
        tag('i', class_='dot out' if out else 'dot', style=f'left:{dot:.1f}%'),
        class_='belief', role='img', title=f'{moved:+.2f} tolerances',
        aria_label=f'{moved:+.2f} tolerances',
    )  # fmt: skip


def correlation(facts: Facts) -> Markup | None:
    """Heat map of the correlations of the identified parameters."""
    names, matrix = facts['correlation']['names'], facts['correlation']['matrix']
    if len(names) < 2 or all(r is None for row in matrix for r in row):
        return None
    short = [_short(name) for name in names]
    body = [
        tag('tr', row(short[a]),
            [_cell(matrix[a][b], names[a], names[b]) if b < a else tag('td') for b in range(a)])
        for a in range(1, len(names))
    ]  # fmt: skip
    head = tag('tr', tag('td'), [column(name) for name in short[:-1]])
    return tag('div',
        tag('h3', 'Correlation of the identified values', style='margin-top:24px'),
        tag('p', 'Near +1 or \u22121 the recordings know a combination of two parameters better '
            'than each of them.', class_='soft'),
        wide('Correlations',
             tag('table', tag('thead', head), tag('tbody', body), class_='heat')),
    )  # fmt: skip


def _short(name: str) -> str:
    owner, dot, own = name.rpartition('.')
    return f'{effect_name(owner)}: {own.replace("_", " ")}' if dot else own


def _cell(r: float | None, a: str, b: str) -> Markup:
    if r is None:
        return tag('td', '\u2013')
    tone = 'var(--after)' if r > 0 else 'var(--before)'
    # Up to there the ink of the page keeps a contrast of 4.5, by day and by night.
    share = round(100 * min(abs(r), 1.0) ** 1.5 * DEEPEST)
    text = f'{r:+.2f}'.replace('-', '\u2212')
    return tag(
        'td',
        text,
        title=f'{a}, {b}: {text}',
        style=f'background:color-mix(in srgb, {tone} {share}%, var(--panel))',
    )
