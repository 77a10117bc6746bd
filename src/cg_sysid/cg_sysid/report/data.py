"""Last part of the page: recordings, their quality, and where everything comes from."""

from cg_sysid.report.markup import Markup, column, row, tag, wide
from cg_sysid.report.wording import ROLES, Facts, input_units, setup_words
from cg_sysid.text import effect_name, listed, number, plain_unit, scaled, sentence


def recordings(facts: Facts) -> Markup | None:
    """Every recording: what it is, what the check says, what it covers."""
    if not facts['sources'] and not facts['records']:
        return None
    return tag('section',
        tag('h2', 'Recordings', id='data-title'),
        _records(facts),
        _windows(facts),
        _noise(facts),
        tag('h3', 'What the check says', style='margin-top:22px') if facts['sources'] else None,
        [_source(s) for s in facts['sources']],
        id='data', aria_labelledby='data-title',
    )  # fmt: skip


def _records(facts: Facts) -> Markup | None:
    if not facts['records']:
        return None
    channels = [c for c in facts['channels'] if c['name'] in facts['gain']]
    head = tag('tr', column('record'), column('use'), column('length', class_='num'),
               column('rate', class_='num'),
               [column('error of ', c['name'], class_='num') for c in channels],
               column('covers'))  # fmt: skip
    rows = [
        tag('tr',
            row(tag('b', r['name']), tag('small', setup_words(r['setup']))),
            tag('td', ROLES[r['role']]),
            tag('td', f'{r["duration_s"]:.1f} s', class_='num'),
            tag('td', f'{number(r["rate_hz"])} Hz', class_='num'),
            [tag('td', _error(r['error'].get(c['name']), c['unit']), class_='num')
             for c in channels],
            tag('td', tag('small', _covers(facts, r))))
        for r in facts['records']
    ]  # fmt: skip
    return wide('Records', tag('table', tag('thead', head), tag('tbody', rows)))


def _windows(facts: Facts) -> Markup | None:
    windows = facts.get('windows')  # not in files of before
    if not windows or not facts['records']:
        return None
    return tag('p', tag('b', 'Windows '), sentence(windows['text']), style='margin-top:12px')


def _error(error: Facts | None, unit: str) -> str:
    if not error or error['after'] is None:
        return '\u2013'
    before, after = error['before'], error['after']
    factor, unit = scaled(max(before or 0.0, after), unit)
    text = f'{number(after * factor)} {unit}'
    if before is not None and abs(before - after) > 1e-3 * after:
        return f'{number(before * factor)} \u2192 {text}'
    return text


def _covers(facts: Facts, record: Facts) -> list[Markup]:
    units = {c['name']: c['unit'] for c in facts['channels']} | input_units(facts)
    return [
        tag('span', f'{name} {number(low, 2)} to {number(high, 2)} '
            f'{plain_unit(units.get(name, ""))}', tag('br'))
        for name, (low, high) in record['coverage'].items()
    ]  # fmt: skip


def _noise(facts: Facts) -> Markup | None:
    units = {c['name']: c['unit'] for c in facts['channels']}
    parts = []
    for name, sigma in facts['noise_floor'].items():
        if sigma is None:
            continue
        factor, unit = scaled(sigma, units[name])
        parts.append(f'{name} {number(sigma * factor, 3)} {unit}')
    if not parts:
        return None
    return tag('p', tag('b', 'Noise floor '), '(white noise and rounding, 1 \u03c3): ',
               ', '.join(parts), '.', style='margin-top:12px')  # fmt: skip


def _source(source: Facts) -> Markup:
    serious = [f for f in source['findings'] if f['severity'] != 'info']
    info = [f for f in source['findings'] if f['severity'] == 'info']
    words = {'good': 'good', 'warnings': 'usable, with warnings', 'unusable': 'unusable'}
    return tag('details',
        tag('summary', source['name'], ' ',
            tag('span', words.get(source['check'], source['check']),
                class_=f'pill {source["check"]}')),
        _findings(serious),
        tag('details', tag('summary', f'{len(info)} observations', class_='soft small'),
            _findings(info)) if info else None,
        None if source['findings'] else tag('p', 'Nothing to remark.', class_='soft'),
        open=not source['used'],
    )  # fmt: skip


def _findings(findings: list[Facts]) -> Markup | None:
    if not findings:
        return None
    rows = [
        tag('tr',
            tag('td', tag('span', f['severity'], class_=f'pill {f["severity"]}')),
            tag('td', f['where'] or '\u2013'),
            tag('td', f['place'], class_='num'),
            tag('td', f['message'], tag('small', f['code'], class_='mono')))
        for f in findings
    ]  # fmt: skip
    columns = tag('colgroup', [tag('col', style=f'width:{w}%') for w in (9, 19, 16, 56)])
    head = tag('tr', column('severity'), column('where'), column('when', class_='num'),
               column('finding'))  # fmt: skip
    return wide('Findings', tag('table', columns, tag('thead', head), tag('tbody', rows)))


def origin(facts: Facts) -> Markup:
    """Everything needed to do it again."""
    p = facts['provenance']
    pairs: list[tuple[str, object]] = [
        ('Date', p.get('created', '')),
        ('Model file', [p.get('model_file', ''), tag('br'), _hash(p.get('model_sha256'))]),
        ('Model', _model(facts['model'])),
        *[(f'Recording {s["name"]}', [s['path'], tag('br'), _hash(s['sha256'])])
          for s in facts['sources']],
        ('Options', ', '.join(f'{k}: {v}' for k, v in (p.get('options') or {}).items())),
        ('Software', ', '.join(f'{k} {v}' for k, v in (p.get('software') or {}).items())),
    ]  # fmt: skip
    if facts.get('fit'):
        fit = facts['fit']
        pairs.append(
            ('Last fit', f'{fit["evaluations"]} simulations of all records in '
             f'{number(fit["seconds"])} s, '
             f'{"converged" if fit["converged"] else "stopped before it had converged"}')
        )  # fmt: skip
    command = ' '.join(_quoted(word) for word in p.get('command') or ())
    pairs.append(('Command', tag('span', command, class_='mono')))
    return tag('section',
        tag('h2', 'Provenance', id='origin-title'),
        tag('dl', [[tag('dt', name), tag('dd', value)] for name, value in pairs]),
        id='origin', aria_labelledby='origin-title',
    )  # fmt: skip


def _model(model: Facts) -> str:
    effects = [effect_name(label) for label in model['effects']]
    extra = f' with {listed(effects)}' if effects else ' without effects'
    return f'{model["name"]}: {model["mechanism"].replace("_", " ")}{extra}'


def _hash(value: str | None) -> Markup:
    return tag('span', f'sha256 {value}' if value else 'no hash', class_='mono soft')


def _quoted(word: str) -> str:
    plain = word and all(c.isalnum() or c in '-_./=,:+@' for c in word)
    return word if plain else "'" + word.replace("'", "'\\''") + "'"
