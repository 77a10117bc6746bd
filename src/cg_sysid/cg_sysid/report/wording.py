"""What the page says in words."""

from typing import Any

from cg_sysid.report.residual_analysis import followed
from cg_sysid.text import effect_name, listed, measured, number, scaled, sentence

Facts = dict[str, Any]

VERDICTS = {
    'consistent': 'The model explains the recordings down to the noise of the sensors.',
    'explained': 'Named causes account for the error.',
    'ambiguous': 'Several causes explain these recordings equally well.',
    'unexplained': 'Something is missing that no known effect explains.',
    'unfinished': 'The search was broken off before it found what explains the error.',
    'unusable': 'The recordings themselves are broken.',
    'identified': 'Parameters of the model as given, fitted to the recordings.',
}
ROLES = {'held': 'held out', 'train': 'fitted', 'all': 'fitted'}  # of a recording
MAINLY = 0.5  # of the squared error: a learned term that takes less makes no headline
MOST_EVENTS = 12  # values of single recordings that are listed
ABOVE_NOISE = 2.0  # multiples of the sensor noise from which an error is spoken of
HINTS = {
    'angle': 'as a missing or wrong force that depends on position would',
    'rate': 'as friction or damping would',
    'torque': 'as an error on the way of the torque would',
}
FIXTURES = {
    'inner_fixed': 'inner legs fixed', 'outer_fixed': 'outer legs fixed', 'legs_tied': 'legs tied',
}  # fmt: skip


def input_units(facts: Facts) -> dict[str, str]:
    """Unit of each input; files that say none are of joints that turn."""
    inputs = facts['inputs']
    return dict(zip(inputs, facts.get('input_units') or ['N m'] * len(inputs), strict=True))


def headline(facts: Facts) -> str:
    """The verdict in a few words."""
    verdict, causes = facts['verdict'], facts['causes']
    if verdict == 'consistent':
        return 'The simulation agrees with the recordings'
    if verdict == 'explained':
        names = listed([effect_name(c['label']) for c in causes])
        return f'The simulation lacks {names}'
    if verdict == 'ambiguous':
        parts = [
            listed([effect_name(x['label']) for x in (c, *c['rivals'])], 'or') for c in causes
        ]
        return f'The simulation lacks {"; and ".join(parts)}'
    if verdict == 'unexplained':
        term = facts.get('unmodelled')
        if term and term['explained'] >= MAINLY:
            return f'The simulation lacks {term["what"]}'
        if facts.get('wandering'):
            return f'From recording to recording {facts["wandering"]["name"]} differs'
        worst = worst_channel(facts)
        at = f' in {worst}' if worst else ''
        return f'There is an error{at} that {_nothing_tried(facts)} explains'
    if verdict == 'unfinished':
        return 'No cause of most of the error was found so far'
    if verdict == 'unusable':
        bad, total = len(facts['unusable']), len(facts['sources'])
        if bad == total:
            return 'The recording is broken' if total == 1 else 'The recordings are broken'
        return f'{bad} of {total} recordings {"is" if bad == 1 else "are"} broken'
    count = sum(not p['fixed'] for p in facts['parameters'])
    return f'{count} parameter{"s" if count != 1 else ""} identified'


def lead(facts: Facts) -> str:
    """One sentence below the headline."""
    verdict = facts['verdict']
    if verdict == 'unusable':
        return 'Nothing was fitted. The places below need repair, or a new recording.'
    if verdict == 'identified' or not facts['gain']:
        return facts['summary']
    landed = facts.get('landings')
    if landed and facts['causes'] and all(c['place'] == 'impact' for c in facts['causes']):
        return landed['text']
    channel = best_channel(facts)
    gain = facts['gain'][channel]
    before, after, noise = gain['before'], gain['after'], gain['noise_floor']
    factor, unit = scaled(max(before, after), gain['unit'])
    left = f'{number(after * factor)} {unit} (sensor noise {number(noise * factor, 2)} {unit})'
    if verdict in ('explained', 'ambiguous'):
        text = (
            f'With {"it" if len(facts["causes"]) == 1 else "them"} in the model, the error of '
            f'{channel} on held-out recordings falls from {number(before * factor)} {unit} to '
            f'{left}.'
        )
        if verdict == 'ambiguous':
            text += ' These recordings cannot tell the alternatives apart.'
        above = list(left_words(facts))
        if above:
            text += f' An error above the noise remains in {listed(above)}.'
        return text
    if verdict == 'consistent':
        return f'On held-out recordings the error of {channel} is {left}.'
    text = (
        f'The simulation misses {channel} by {left} on held-out recordings, and '
        f'{_nothing_tried(facts)} explains that.'
    )
    if term := facts.get('unmodelled'):
        share = f'{number(100 * term["explained"], 2)} % of '
        text += f' A learned function describes {share * (term["explained"] < MAINLY)}it.'
    if facts['causes']:
        names = [effect_name(c['label']) for c in facts['causes']]
        text += (
            f' {sentence(listed(names))} {"takes" if len(names) == 1 else "take"} less than half '
            'of the error, and may only stand in for what is missing.'
        )
    late = facts.get('late_samples')
    return f'{text} {late}' if late else text


def _nothing_tried(facts: Facts) -> str:
    tried = facts['provenance'].get('options', {}).get('effects', 'all')
    if tried == 'all':
        return 'no known effect'
    return f'no effect tried ({listed([effect_name(label) for label in tried.split(",")], "or")})'


def left_words(facts: Facts) -> dict[str, str]:
    """Output -> what its remaining error looks like, for those above the noise."""
    found = {}
    for channel, error in facts['remaining_error'].items():
        if (error['in_noise'] or 0.0) <= ABOVE_NOISE:
            continue
        words = [f'{number(error["in_noise"], 2)} times the sensor noise']
        frequency = error.get('median_frequency_hz')
        if frequency:
            words.append(f'half of its power below {number(frequency, 2)} Hz')
        # A learned term says it better.
        follows = {} if facts.get('unmodelled') else error.get('follows') or {}
        name = followed(follows)
        if name:
            share, hint = f'{100 * follows[name]:.0f} %', HINTS.get(name, HINTS['torque'])
            quantity = name.replace('_', ' ')
            words.append(f'its acceleration follows the {quantity} ({share}), {hint}')
        elif follows:
            words.append('its acceleration follows neither angle nor rate nor torque alone')
        found[channel] = '; '.join(words)
    return found


def best_channel(facts: Facts) -> str:
    """The output whose error before is largest beside its noise."""
    return max(facts['gain'], key=lambda c: _ratio(facts['gain'][c], 'before'))


def worst_channel(facts: Facts) -> str | None:
    """The output whose error after is largest beside its noise."""
    if not facts['gain']:
        return None
    return max(facts['gain'], key=lambda c: _ratio(facts['gain'][c], 'after'))


def _ratio(gain: Facts, key: str) -> float:
    return (gain[key] or 0.0) / (gain['noise_floor'] or 1.0)


def setup_words(setup: Facts) -> str:
    """A set-up in a few words."""
    words: list[str] = []
    if setup.get('fixture', 'none') != 'none':
        words.append(FIXTURES.get(setup['fixture'], str(setup['fixture'])))
    else:
        words.append(f'stance {setup.get("stance", "inner")}')
    springs = len(setup.get('springs') or ())
    if springs:
        words.append(f'{springs} spring{"s" if springs > 1 else ""}')
    return ', '.join(words)


def event_words(cause: Facts) -> list[str]:
    """`in swing_1: zero -6.4 ± 0.6 mrad`, one for each recording that has its own value."""
    told: dict[str, list[str]] = {}
    for record, values in cause['events'].items():
        told.setdefault(', '.join(parameter_words(values)), []).append(record)
    # Where pieces share it, it is the recording's: its name is theirs up to the bracket.
    found = [
        f'in {records[0].partition("[")[0] if len(records) > 1 else records[0]}: {words}'
        for words, records in told.items()
    ]
    more = len(found) - MOST_EVENTS
    return [*found[:MOST_EVENTS], f'and {more} more in diagnosis.json'] if more > 0 else found


def replaced_words(cause: Facts) -> list[str]:
    """That it makes an effect of the model itself idle, in at most one sentence."""
    names = [effect_name(label) for label in cause.get('replaces', ())]
    return [f'it replaces {listed(names)} of the model, of which nothing is left'] if names else []


def undetermined_words(cause: Facts) -> list[str]:
    """That some of its parameters say that it may be something else, in at most one sentence."""
    vague, ended = (cause.get(which, ()) for which in ('undetermined', 'at_edge'))
    reasons = []
    if vague:
        reasons.append(f'these recordings do not determine {_names(vague)}')
    if ended := [name for name in ended if name not in vague]:
        reasons.append(f'the fit drove {_names(ended)} to the edge of what was tried')
    if not reasons:
        return []
    return [f'{"; ".join(reasons)}: what acts like this need not be what it is named after']


def _names(parameters: list[str]) -> str:
    return ' and '.join(name.replace('_', ' ') for name in parameters)


def parameter_words(parameters: Facts) -> list[str]:
    """`delay 8.01 ± 0.05 ms`, one for each parameter."""
    return [f'{name.replace("_", " ")} {value_words(p)}' for name, p in parameters.items()]


def value_words(parameter: Facts) -> str:
    """`8.01 ± 0.05 ms`, or that the recordings do not determine it."""
    if not parameter.get('determined', True):
        return 'not determined'
    return measured(parameter['value'], parameter['sigma'], parameter['unit'])
