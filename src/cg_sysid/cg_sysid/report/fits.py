"""Second part of the page: measured against simulated, and what is left over."""

from cg_sysid.report.markup import Markup, tag
from cg_sysid.report.wording import ROLES, Facts, best_channel, setup_words, worst_channel

HINT = 'Drag to zoom, double-click for the whole record.'


def compares(facts: Facts) -> bool:
    """Whether there is a before and an after."""
    return any(
        g['before'] is not None and abs(g['before'] - g['after']) > 1e-3 * g['after']
        for g in facts['gain'].values()
    )


def _legend(both: bool, noise: str) -> Markup:
    keys = [('measured', 'measured')] if noise.startswith('\u00b12') else []
    keys += [('before', 'before'), ('after', 'after')] if both else [('after', 'simulated')]
    keys.append(('floor' if 'density' in noise else 'noise', noise))
    return tag('div', [tag('span', tag('i', class_=f'k-{k}'), text) for k, text in keys],
               class_='legend')  # fmt: skip


def viewer(facts: Facts, drawn: Facts) -> Markup | None:
    """The interactive plot of one record."""
    if not drawn['records']:
        return None
    both = compares(facts)
    names = [c['name'] for c in facts['channels']]
    first = names.index(best_channel(facts)) if facts['gain'] else 0
    by_name = {r['name']: r for r in facts['records']}
    groups: dict[str, list[Markup]] = {}
    for k, record in enumerate(drawn['records']):
        known = by_name.get(record['name'])
        words = setup_words(known['setup']) if known else ''
        text = f'{record["name"]} ({ROLES[record["role"]]})'
        groups.setdefault(words, []).append(tag('option', text, value=k, selected=k == 0))
    spans = [('whole', 0), ('5 s', 5), ('1 s', 1), ('0.2 s', 0.2)]
    thinned = drawn['thinned']
    note = f' One sample in {thinned} is shown.' if thinned > 1 else ''
    missing = len(facts['records']) - len(drawn['records'])
    note += f' {missing} more records are not shown.' if missing > 0 else ''
    return tag('section',
        tag('h2', 'Measured and simulated', id='signals-title'),
        tag('p', 'Each simulation starts from its own fitted initial motion and then runs '
            f'free, driven by the recorded torque alone.{note}', class_='soft'),
        tag('div',
            tag('div',
                tag('label', 'Record ', tag('select',
                    [tag('optgroup', options, label=words) for words, options in groups.items()],
                    aria_label='record')),
                tag('div', class_='tabs group', role='group', aria_label='output'),
                tag('div',
                    [tag('button', t, type='button', data_span=s) for t, s in spans],
                    tag('button', '\u2190', type='button', data_shift=-0.5, title='earlier',
                        aria_label='earlier'),
                    tag('button', '\u2192', type='button', data_shift=0.5, title='later',
                        aria_label='later'),
                    class_='group', role='group', aria_label='span of time'),
                tag('label', tag('input', type='checkbox'), ' residual on the scale of after')
                if both else None,
                class_='controls'),
            _legend(both, '\u00b12 \u03c3 of the sensor noise'),
            tag('div', class_='signal'), tag('div', class_='residual'),
            tag('div', class_='torque'),
            tag('div', HINT, class_='readout', data_hint=HINT),
            id='viewer', data_channel=first, data_both=int(both)),
        id='signals', aria_labelledby='signals-title',
    )  # fmt: skip


def residuals(facts: Facts, drawn: Facts) -> Markup | None:
    """Spectra of the residuals, and residuals against states."""
    if not drawn['records']:
        return None
    both = compares(facts)
    spectra = [
        tag('figure', tag('figcaption', c),
            tag('div', class_='spectrum', data_channel=c, data_both=int(both)))
        for c, s in drawn['spectra'].items() if s
    ]  # fmt: skip
    states = [
        tag('div',
            tag('h4', channel),
            tag('div', [
                tag('div', class_='against cell', data_channel=channel, data_index=k,
                    data_both=int(both))
                for k in range(len(axes))
            ], class_='plots'), class_='states')
        for channel, axes in _ordered(facts, drawn) if axes
    ]  # fmt: skip
    which = 'held-out recordings' if facts['verdict'] != 'identified' else 'all recordings'
    return tag('section',
        tag('h2', 'What is left', id='residuals-title'),
        tag('p', f'Simulated minus measured, over {which}. An error that the model could still '
            'explain shows as a hump in the spectrum or as a trend over angle, rate or torque; '
            'pure sensor noise is flat in all of them.', class_='soft'),
        tag('h3', 'Spectrum of the residual'),
        _legend(both, 'density of the sensor noise'),
        tag('div', spectra, class_='plots'),
        tag('h3', 'Residual against angle, rate and torque', style='margin-top:26px'),
        _legend(both, 'sensor noise (1 \u03c3); shading is the spread around the mean'),
        states,
        id='residuals', aria_labelledby='residuals-title',
    )  # fmt: skip


def _ordered(facts: Facts, drawn: Facts):
    """The output with the largest error first."""
    if not facts['gain']:
        return drawn['states'].items()
    first = best_channel(facts) if compares(facts) else worst_channel(facts)
    return sorted(drawn['states'].items(), key=lambda item: item[0] != first)
