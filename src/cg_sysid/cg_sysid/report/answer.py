"""First part of the page: verdict, causes, gain."""

import math

from cg_sysid.report.function import unmodelled
from cg_sysid.report.landings import landings
from cg_sysid.report.markup import Markup, column, row, tag
from cg_sysid.report.wording import (
    VERDICTS,
    Facts,
    event_words,
    headline,
    lead,
    left_words,
    parameter_words,
    replaced_words,
    undetermined_words,
)
from cg_sysid.text import effect_name, listed, measured, number, scaled, sentence

WORTH_NATS = 6.0  # that an experiment must promise to be worth its while
MOST_STANDINGS = 8  # candidates of a search that was broken off that are listed
PLACES = {
    'command': '; it acts on the way of the command',
    'transmission': '; it acts in the transmission',
    'joint': '; it acts at the joint',
    'body': '; it acts on a body',
    'environment': '; it acts from the environment',
    'impact': '; it acts at impact',
    'sensor': '; it acts in a sensor',
    'timing': '; it acts on the timing',
}


def answer(facts: Facts, drawn: Facts) -> Markup:
    """The answer in words, the causes and the gain."""
    verdict = facts['verdict']
    left = [
        _unfinished(facts),
        *[_cause(cause) for cause in facts['causes']],
        unmodelled(facts),
        _wandering(facts),
        landings(facts),
        _faults(facts, drawn),
        _where(facts),
        _left_out(facts),
        _overruled(facts),
    ]
    left = [part for part in left if part is not None]
    right = [part for part in (gain(facts),) if part is not None]
    notes = _notes(facts)
    if notes is not None:
        (right if left else left).append(notes)
    both = bool(left) and bool(right)
    return tag('section',
        tag('span', verdict, class_='verdict', title=VERDICTS[verdict]),
        tag('h1', sentence(headline(facts)), id='answer-title'),
        tag('p', lead(facts), class_='lead'),
        tag('p', tag('b', 'Next: '), facts['next'], class_='todo') if facts.get('next') else None,
        tag('div', tag('div', left) if left else None, tag('div', right) if right else None,
            class_='columns' if both else 'columns one'),
        class_=f'hero {verdict}', id='answer', aria_labelledby='answer-title',
    )  # fmt: skip


def _unfinished(facts: Facts) -> Markup | None:
    found = facts.get('unfinished')
    if found is None:
        return None
    rows = [
        tag('tr', row(effect_name(one['label'])), tag('td', number(one['in_noise'])),
            tag('td', 'whole records' if one['whole_records'] else 'first seconds'))
        for one in found['ranking'][:MOST_STANDINGS]
    ]  # fmt: skip
    table = tag('table',
        tag('thead',
            tag('tr', column('candidate'), column('error left, in noise'), column('in'))),
        tag('tbody', rows),
    )  # fmt: skip
    return tag('div',
        tag('h2', 'The best answer so far'),
        tag('p', found['text']),
        table if rows else None,
        class_='card', id='unfinished',
    )  # fmt: skip


def _wandering(facts: Facts) -> Markup | None:
    found = facts.get('wandering')
    if found is None:
        return None
    rows = [
        tag('tr', row(recording, class_='mono'),
            tag('td', measured(own['value'], own['sigma'], found['unit'])))
        for recording, own in found['values'].items()
    ]  # fmt: skip
    return tag('div',
        tag('h2', 'What differs between recordings'),
        tag('p', found['text']),
        tag('table',
            tag('thead', tag('tr', column('recording'), column(found['name']))),
            tag('tbody', rows)),
        class_='card', id='wandering',
    )  # fmt: skip


def _cause(cause: Facts) -> Markup:
    where = f' at {cause["at"]}' if cause['at'] else ''
    evidence = cause['evidence_nats']
    proof = (
        f'Evidence {number(evidence)} nats over the model without it'
        if evidence is not None
        else 'Without it the model cannot follow the recordings at all'
    )
    return tag('div',
        tag('h2', sentence(effect_name(cause['name'])), where),
        [tag('p', words, class_='big') for words in parameter_words(cause['parameters'])],
        [tag('p', words, class_='soft') for words in event_words(cause)],
        [tag('p', f'{sentence(words)}.') for words in replaced_words(cause)],
        [tag('p', f'{sentence(words)}.', class_='doubt') for words in undetermined_words(cause)],
        tag('p', cause['description'], class_='soft'),
        tag('p', f'{proof}{PLACES.get(cause["place"], "")}.', class_='soft small'),
        [tag('div', tag('b', 'Could also be ', effect_name(r['label'])),
             tag('p', r['description'], class_='soft small'), class_='rival')
         for r in cause['rivals']],
        _next_experiment(cause),
        tag('div', tag('b', 'Could also act elsewhere: '),
            listed([effect_name(p) for p in cause['places']], 'or'), class_='rival')
        if cause['places'] else None,
        class_='card',
    )  # fmt: skip


def _next_experiment(cause: Facts) -> Markup | None:
    """What to record next where rivals are left."""
    if not cause['next_experiments']:
        return None
    best = cause['next_experiments'][0]
    if best['expected_nats'] < WORTH_NATS:
        words = 'No experiment that can be launched would tell them apart.'
        return tag('p', words, class_='soft next')
    torque = best['excitation']
    fastest = f' up to {number(torque["f_max"])} Hz' if 'f_max' in torque else ''
    return tag('p',
        tag('b', 'Next: '), tag('code', best['experiment']),
        f' ({torque["kind"]}{fastest}, {number(best["duration_s"])} s) would tell ',
        listed([effect_name(name) for name in best['tells_apart']], 'and'),
        f' apart with about {number(best["expected_nats"])} nats.',
        class_='next',
    )  # fmt: skip


def _faults(facts: Facts, drawn: Facts) -> Markup | None:
    """Where the recordings are broken, if that is the story."""
    if facts['verdict'] != 'unusable':
        return None
    parts = []
    for source in facts['sources']:
        errors = [f for f in source['findings'] if f['severity'] == 'error']
        if source['used']:
            continue
        parts.append(tag('h2', source['name']))
        for f in errors:
            where = ', '.join(w for w in (f['where'], f['place']) if w)
            parts.append(tag('div',
                tag('b', where or 'the whole recording'),
                tag('p', sentence(f['message']), '.'),
                _plot(drawn, source['name'], f),
                class_='fault',
            ))  # fmt: skip
    used = [s['name'] for s in facts['sources'] if s['used']]
    if used:
        parts.append(tag('p', 'Fit for use: ', listed(used), '. A diagnosis needs at least two '
                         'recordings, one to fit and one to judge.', class_='soft'))  # fmt: skip
    return tag('div', parts, class_='card')


def _plot(drawn: Facts, source: str, finding: Facts) -> Markup | None:
    """The signal around a fault, where there is one."""
    for k, signal in enumerate(drawn['faults']):
        if (signal['source'], signal['code']) == (source, finding['code']) and (
            signal['span'][0] == finding['start_s']
        ):
            return tag('div', class_='faultplot', data_index=k)
    return None


def _where(facts: Facts) -> Markup | None:
    """What an error that nothing explains looks like."""
    words = left_words(facts)
    if not words or facts['verdict'] == 'unusable':
        return None
    return tag('div',
        tag('h2', 'Where an error is left'),
        [tag('p', tag('b', channel), f': {text}.') for channel, text in words.items()],
        class_='card',
    )  # fmt: skip


def _left_out(facts: Facts) -> Markup | None:
    if facts['verdict'] == 'unusable' or not facts['unusable']:
        return None
    return tag('div',
        tag('h2', 'Left out'),
        tag('p', 'These recordings are broken; the answer stands on the others.', class_='soft'),
        [tag('div', tag('b', u['name']), tag('p', u['reason']), class_='fault')
         for u in facts['unusable']],
        class_='card',
    )  # fmt: skip


def _overruled(facts: Facts) -> Markup | None:
    if not facts.get('overruled'):
        return None
    return tag('div',
        tag('h2', 'Used anyway'),
        tag('p', 'The check refuses these recordings; they are used because it was overruled.',
            class_='soft'),
        [tag('div', tag('b', f'{entry["name"]}: {entry["code"]}'),
             tag('p', ' '.join(w for w in (entry['where'], entry['place'], entry['reason']) if w)),
             class_='fault')
         for entry in facts['overruled']],
        class_='card', id='overruled',
    )  # fmt: skip


def _notes(facts: Facts) -> Markup | None:
    if not facts['findings']:
        return None
    notes = facts['findings']
    items = tag('ul', [tag('li', note) for note in notes], class_='notes small')
    if len(notes) > 4 and facts['causes']:
        items = tag('details', tag('summary', f'{len(notes)} remarks on the fit'), items)
        return tag('div', items, class_='card')
    return tag('div', tag('h2', 'Worth knowing'), items, class_='card')


def gain(facts: Facts) -> Markup | None:
    """Error before and after in multiples of the noise, on a logarithmic scale."""
    rows = {c: g for c, g in facts['gain'].items() if g['noise_floor'] and g['after'] is not None}
    if not rows:
        return None
    changed = any(_changed(g) for g in rows.values())
    ratios = [g[k] / g['noise_floor'] for g in rows.values() for k in ('before', 'after') if g[k]]
    low = min(0.5, 0.8 * min(ratios))
    high = max(20.0, 1.5 * max(ratios))
    ticks = _ticks(low, high)

    def at(ratio: float) -> str:
        share = (math.log(ratio) - math.log(low)) / (math.log(high) - math.log(low))
        return f'{100 * min(max(share, 0.0), 1.0):.2f}%'

    cells = []
    for channel, g in rows.items():
        cells += [_name(channel, g), _dumbbell(g, at, ticks), _values(g)]
    held = facts['verdict'] != 'identified'
    title = 'Error on held-out recordings' if held else 'Error on all recordings'
    legend = [_key('after', 'after' if changed else 'simulated'), _key('floor', 'sensor noise')]
    if changed:
        before = 'before (identified anew)' if held else 'before (as given)'
        legend.insert(0, _key('before', before))
    return tag('div',
        tag('h2', title),
        tag('div', legend, class_='legend'),
        tag('div', cells,
            tag('div'), tag('div', [tag('span', f'{t:g}', style=f'left:{at(t)}') for t in ticks],
                            class_='scale', aria_hidden='true'), tag('div'),
            tag('div', 'error / sensor noise', class_='axis', aria_hidden='true'),
            class_='gain'),
        _second_judgement(facts),
        class_='card',
    )  # fmt: skip


def _second_judgement(facts: Facts) -> Markup | None:
    """The same where records start at the angles that were measured."""
    found = facts.get('gain_from_measured_start')
    if not found:
        return None
    text = found['text']
    return tag('p', f'{text[0].upper()}{text[1:]}.', class_='small')


def _key(kind: str, text: str) -> Markup:
    return tag('span', tag('i', class_=f'k-{kind}'), text)


def _changed(g: Facts) -> bool:
    return g['before'] is not None and abs(g['before'] - g['after']) > 1e-3 * g['after']


def _ticks(low: float, high: float) -> list[float]:
    first, last = math.ceil(math.log10(low) - 1e-9), math.floor(math.log10(high) + 1e-9)
    every = 1 if last - first < 5 else 2
    return [10.0**k for k in range(first, last + 1) if k % every == 0]


def _dumbbell(g: Facts, at, ticks: list[float]) -> Markup:
    noise = g['noise_floor']
    after = at(g['after'] / noise)
    marks = [
        *[tag('i', class_='tick', style=f'left:{at(t)}') for t in ticks],
        tag('i', class_='unit', style=f'left:{at(1.0)}'),
    ]
    if _changed(g):
        before = at(g['before'] / noise)
        ends = sorted((float(before[:-1]), float(after[:-1])))
        marks += [
            tag('i', class_='stem', style=f'left:{ends[0]}%;width:{ends[1] - ends[0]:.2f}%'),
            tag('i', class_='dot', style=f'left:{before}'),
        ]
    marks.append(tag('i', class_='dot to', style=f'left:{after}'))
    return tag('div', marks, class_='track', aria_hidden='true')  # its numbers stand beside it


def _values(g: Facts) -> Markup:
    factor, unit = scaled(max(g['after'], g['before'] or 0.0), g['unit'])
    text = f'{number(g["after"] * factor)} {unit}'
    if _changed(g):
        text = f'{number(g["before"] * factor)} \u2192 {text}'
    note = None
    if _changed(g) and g['ratio'] and g['ratio'] > 1.05:
        note = tag('small', f'{number(g["ratio"], 2)}\u00d7 smaller')
    return tag('div', text, note, class_='value')


def _name(channel: str, g: Facts) -> Markup:
    factor, unit = scaled(g['noise_floor'], g['unit'])
    noise = f'noise {number(g["noise_floor"] * factor, 2)} {unit}'
    return tag('div', channel, tag('small', noise), class_='name')
