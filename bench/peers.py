"""The diagnosis beside its peers: the same hidden recordings, in the same run, as a table.

    tools/setup.sh bench                                             # pysindy, mujoco.sysid
    ./cg exec python bench/peers.py [--seeds 2] [--effects a,b] [--only PEER] [--raw FILE]
        [--write FILE]

The recordings are those of bench/hidden_effects.py: a robot 10 to 20 % off its nominal file, with
one effect of drawn size hidden in it or none, eight records of 8 s, four to fit and four to judge
on. Peers, each a module of bench/peers:

    diagnosis       ours
    grey_box        least_squares for each effect of our library, one start, ranked by BIC
    sindy           pysindy's sparse regression, our library as its candidate functions
    sindy_told      the same, told the true rigid body and friction of the machine
    mujoco_sysid    mujoco.sysid on a MuJoCo model of the robot with all its native parameters

Every run is one line of `--raw`, and the table is made from all lines there: long runs can be done
in pieces. Thresholds of the peers were set on seeds from 201 on, which this bench does not use.
"""

import argparse
import importlib
import json
import time
from dataclasses import asdict, dataclass, replace
from pathlib import Path

import numpy as np
from hidden_effects import hide, records_of
from peers import Answer, Case, NameCause

from cg_description.paths import NOMINAL_MODEL, model_path
from cg_dynamics.model import Model
from cg_sysid.diagnosis.diagnose import diagnose, split
from cg_sysid.identification.data_set import LEAD_IN_S, prepare
from cg_sysid.search.ranking import effect_name

EFFECTS = (
    'actuator_delay', 'backlash', 'joint_flexibility', 'coulomb_friction', 'stribeck_friction',
    'quadratic_friction', 'payload', 'ground_slope', 'torque_bias', 'cogging_torque',
    'encoder_scale', 'spring_nonlinearity', 'imu_lag', 'torque_constant',
)  # fmt: skip
PEERS = ('diagnosis', 'grey_box', 'sindy', 'sindy_told', 'mujoco_sysid')
HEALTHY = 'none'
# The same by physics, but for the first moments of a record: a late torque and late sensors.
SAME = ({'actuator_delay', 'sensor_delay'},)
AT_NOISE = 1.3  # chi2/N of a model that leaves no more than noise


@dataclass(frozen=True)
class Row:
    """One peer on one case."""

    peer: str
    effect: str
    seed: int
    answer: Answer
    before: float
    seconds: float

    @property
    def right(self) -> bool:
        """The hidden effect was named first, or what physics makes the same."""
        same = next((s for s in SAME if self.effect in s), {self.effect})
        return self.answer.cause in same if self.effect != HEALTHY else not self.answer.cause


def hidden_case(effect: str, seed: int) -> tuple[Case, list]:
    """Data sets of a machine with a secret, and the records behind them."""
    secret = [] if effect == HEALTHY else [effect]
    nominal, machine, _ = hide(Model.load(model_path(NOMINAL_MODEL)), secret, 1.0, seed)
    records = records_of(machine, seed)
    # As the diagnosis does: what a delay or a lag was before the first row nobody knows.
    data_sets = [
        replace(t, outputs=np.where(t.time[:, None] < LEAD_IN_S, np.nan, t.outputs))
        for t in prepare(nominal, records)
    ]
    train, held = split(data_sets)
    told = machine.without_effect(effect) if secret else machine
    return Case(nominal, tuple(train), tuple(held), told), records


def our_answer(case: Case, records: list) -> Answer:
    """The diagnosis: its strongest cause."""
    found = diagnose(case.nominal, records)
    cause = found.causes[0] if found.causes else None
    return Answer(
        effect_name(cause.label) if cause else '',
        found.extended.held.normalised_error,
        cause.evidence if cause else 0.0,
    )


def name_cause(peer: str) -> NameCause:
    """The function of a peer's module; its packages are wanted only where it is."""
    module = importlib.import_module(f'peers.{peer.removesuffix("_told")}')
    return module.name_cause_told if peer.endswith('_told') else module.name_cause


def run(peer: str, effect: str, seed: int, case: Case, records: list, before: float) -> Row:
    began = time.monotonic()
    answer = our_answer(case, records) if peer == 'diagnosis' else name_cause(peer)(case)
    row = Row(peer, effect, seed, answer, before, time.monotonic() - began)
    print(
        f'{effect} {seed} {peer}: {answer.cause or "-"}, chi2/N {before:.3g} -> '
        f'{answer.error:.3g}, strength {answer.strength:.3g}, {row.seconds:.0f} s',
        flush=True,
    )
    return row


def tables(rows: list[Row]) -> str:
    """What all rows say: one line per peer, then one per effect."""
    lines = [
        '| peer | first cause right | false alarms | held-out error falls by | down to noise '
        '| s per case |',
        '|---|---:|---:|---:|---:|---:|',
    ]
    peers = [peer for peer in PEERS if any(r.peer == peer for r in rows)]
    for peer in peers:
        own = [r for r in rows if r.peer == peer]
        hidden = [r for r in own if r.effect != HEALTHY]
        healthy = [r for r in own if r.effect == HEALTHY]
        gains = [np.sqrt(r.before / r.answer.error) for r in hidden]
        lines.append(
            f'| {peer} | {share(r.right for r in hidden)} '
            f'| {share(not r.right for r in healthy)} '
            f'| {f"{np.median(gains):.3g} x" if gains else "-"} '
            f'| {share(r.answer.error < AT_NOISE for r in hidden)} '
            f'| {np.median([r.seconds for r in own]) if own else np.nan:.0f} |'
        )
    lines += ['', f'| hidden | {" | ".join(peers)} |', f'|---|{"---|" * len(peers)}']
    for effect in dict.fromkeys(r.effect for r in rows):
        cells = []
        for peer in peers:
            own = [r for r in rows if r.peer == peer and r.effect == effect]
            wrong = sorted({r.answer.cause or '-' for r in own if not r.right})
            cells.append(share(r.right for r in own) + (f' ({", ".join(wrong)})' if wrong else ''))
        lines.append(f'| {effect} | {" | ".join(cells)} |')
    return '\n'.join(lines) + '\n'


def share(found) -> str:
    found = list(found)
    return f'{sum(found)} of {len(found)}' if found else '-'


def baseline(case: Case) -> float:
    """chi2/N on the held-out data sets of the nominal model, identified anew."""
    from peers import grey_box

    found = grey_box.identify_nominal(case)
    return grey_box.held_error(case.nominal.with_values(found.values), case.held)


def main():
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument('--seeds', type=int, default=2, help='cases of each effect')
    parser.add_argument('--healthy', type=int, help='healthy cases [three times --seeds]')
    parser.add_argument('--first', type=int, default=101, help='first seed')
    parser.add_argument('--effects', help='hide only these')
    parser.add_argument('--only', metavar='PEER', help=f'only these of {", ".join(PEERS)}')
    parser.add_argument('--raw', type=Path, default=Path('bench/results/peers.jsonl'))
    parser.add_argument('--write', type=Path, help='file for the tables')
    parser.add_argument('--table-only', action='store_true', help='run nothing')
    options = parser.parse_args()
    effects = options.effects.split(',') if options.effects else list(EFFECTS)
    peers = options.only.split(',') if options.only else list(PEERS)
    for peer in peers:
        if peer not in PEERS:
            parser.error(f'--only: no peer {peer!r}; there are {", ".join(PEERS)}')
        if peer != 'diagnosis':
            name_cause(peer)
    healthy = 3 * options.seeds if options.healthy is None else options.healthy
    for effect in () if options.table_only else (HEALTHY, *effects):
        for k in range(healthy if effect == HEALTHY else options.seeds):
            case, records = hidden_case(effect, options.first + k)
            before = baseline(case)
            for peer in peers:
                row = run(peer, effect, options.first + k, case, records, before)
                with options.raw.open('a') as raw:
                    raw.write(json.dumps(asdict(row)) + '\n')
    lines = [json.loads(line) for line in options.raw.read_text().splitlines()]
    rows = [Row(**{**line, 'answer': Answer(**line['answer'])}) for line in lines]
    print(tables(rows))
    if options.write:
        write(options.write, rows)


def write(file: Path, rows: list[Row]) -> None:
    text = (
        '# The diagnosis and its peers\n\n'
        f'Command: `python bench/peers.py --table-only --write FILE`; {len(rows)} runs. What the '
        'peers are and get: `bench/peers.py` and the modules of `bench/peers`.\n\n'
        'Right: the first cause that it names is the hidden one, or what physics makes the same. '
        'The error is the RMS simulation error over noise on held-out records, from that of the '
        'nominal model identified anew; median. Time is wall time on this machine; the diagnosis '
        'uses one process per core, mujoco_sysid two threads, the others one.\n\n'
    )
    file.write_text(text + tables(rows))


if __name__ == '__main__':
    main()
