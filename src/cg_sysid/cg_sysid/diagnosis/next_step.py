"""What to do after an answer: with the model, with the next experiment, with the machine.

Read from the facts of the answer (diagnosis_json.md), so that the file, the command line and the
report say the same.
"""

from collections.abc import Mapping
from typing import Any

from cg_sysid.search import settings
from cg_sysid.text import effect_name, listed, number

# Where an effect acts -> what a person can look at there, with the machine switched off.
CHECKS = {
    'command': 'the limits, the offset and the torque constant that the drive is set to',
    'transmission': 'the gear and the couplings, for play and twist',
    'joint': 'bearings and gear, by turning the joint by hand',
    'body': 'what is mounted on the bodies, by weighing them',
    'environment': 'what touches or pulls the machine: cables, springs, ground',
    'impact': 'the soles and the ground',
    'sensor': 'zero, scale and mount of the sensor',
    'timing': 'the cycle of the drive and the stamps of the sensors',
}


def next_step(facts: Mapping[str, Any]) -> str:
    """What to do next, in at most a few sentences; said for every verdict.

    Args:
        facts: Of a diagnosis or identification, all but this field.
    """
    broken_off = (
        'Run the same command again with a longer --budget: it goes on from the fits that are '
        'kept. '
        if facts.get('unfinished')
        else ''
    )
    return broken_off + _AFTER[facts['verdict']](facts)


def _consistent(facts: Mapping[str, Any]) -> str:
    away = [
        p['name']
        for p in facts['parameters']
        if p['moved_tolerances'] is not None
        and abs(p['moved_tolerances']) > settings.PRIOR.conflict
    ]
    if away:
        return (
            f'Measure {listed(away)} on the machine, or correct the tolerance in the model file: '
            'the records want a value that the file rules out.'
        )
    return (
        'Simulate with model.yaml, whose numbers are those of these records. Of set-ups, speeds '
        'and torques that they do not cover they say nothing: record those next.'
    )


def _explained(facts: Mapping[str, Any]) -> str:
    use = 'Simulate with model.yaml, which has the causes in it.'
    if any(cause['undetermined'] or cause.get('at_edge') for cause in facts['causes']):
        use = (
            'Simulate with model.yaml for motions like these only: some of its numbers are not '
            'determined, or ended at the edge of what was tried. Record faster and larger motions '
            'next.'
        )
    return f'{use} {_look(facts)}'


def _ambiguous(facts: Mapping[str, Any]) -> str:
    experiments = [cause['next_experiments'][0] for cause in facts['causes']
                   if cause['next_experiments']]  # fmt: skip
    # Of a proposal without a number nobody knows what it is worth.
    best = max(experiments, key=lambda e: e['expected_nats'] or 0.0, default=None)
    if best is not None and (best['expected_nats'] or 0.0) > settings.SELECTION.margin:
        torque = best['excitation']
        fastest = f' up to {number(torque["f_max"])} Hz' if 'f_max' in torque else ''
        return (
            f'Run {best["experiment"]} ({torque["kind"]}{fastest}, '
            f'{number(best["duration_s"])} s) and diagnose again with its bag beside these: it '
            f'would tell {listed([effect_name(label) for label in best["tells_apart"]])} apart.'
        )
    tried = ('No experiment that can be launched tells them apart'
             if best is not None else 'These records do not tell them apart')  # fmt: skip
    return f'{tried}; for motions like these model.yaml serves. {_look(facts)}'


def _unexplained(facts: Mapping[str, Any]) -> str:
    if facts['wandering']:
        return (
            f'Find out what changed {facts["wandering"]["name"]} between the recordings: '
            'warming, wear, mounting, or a sensor that is zeroed anew.'
        )
    if facts['late_samples']:
        return 'Mend the stamps of the samples, or record again, before you look for a cause.'
    if facts['unmodelled']:
        return (
            'Until the cause is known, simulate with learned.yaml within what the records cover. '
            f'On the machine look for {facts["unmodelled"]["what"]}.'
        )
    return (
        'Do not trust the model where the report shows an error. Record motions that differ in '
        'one thing at a time (slow and fast, small and large, with and without torque) to see '
        'what it goes with.'
    )


def _unfinished(facts: Mapping[str, Any]) -> str:
    return 'Until then do not trust the model where the report shows an error.'


def _unusable(facts: Mapping[str, Any]) -> str:
    names = [entry['name'] for entry in facts['unusable']]
    if not names:
        return 'Record at least two recordings, one to fit and one to judge.'
    first = facts['unusable'][0]
    place = ', '.join(word for word in (first['where'], first['place']) if word)
    where = f'{first["name"]} at {place}' if place else first['name']
    return f'Look at {where}, mend what is behind it, and record {listed(names)} again.'


def _identified(facts: Mapping[str, Any]) -> str:
    return (
        'Simulate with model.yaml. Whether its structure is right, and not only its numbers, '
        'cg diagnose tells.'
    )


def _look(facts: Mapping[str, Any]) -> str:
    """What to check on the machine: of each cause, and of its rivals."""
    every = [effect for cause in facts['causes'] for effect in (cause, *cause['rivals'])]
    places = dict.fromkeys(effect['place'] for effect in every)
    looks = [CHECKS[place] for place in places if place in CHECKS]
    return f'On the machine check {listed(looks)}.' if looks else ''


_AFTER = {
    'consistent': _consistent,
    'explained': _explained,
    'ambiguous': _ambiguous,
    'unexplained': _unexplained,
    'unfinished': _unfinished,
    'unusable': _unusable,
    'identified': _identified,
}
