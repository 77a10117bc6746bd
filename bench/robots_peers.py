"""What peers make of the recordings of `robots.py`, beside what the diagnosis made of them.

    tools/setup.sh bench                                                # mujoco.sysid
    ./cg exec python bench/robots_peers.py [--toolbox 'arm2:*'] [--seconds 300]
        [--ours bench/results/robots.jsonl] [--write FILE]

All get the URDF as its owner has it, and the same bags. The peers fit the records that the
diagnosis fits, cut into the same windows, and are judged by those that it holds out:

    least_squares   base parameters, rotor, viscous and dry friction and bias of every joint, by
                    the torques: what the toolboxes of robot arms do (base_parameters.py)
    mujoco_sysid    mujoco.sysid on that URDF as MuJoCo reads it: mass and centre of all links (its
                    default), damping, dry friction and armature of all joints and the gain of
                    each drive at once

The machines are MuJoCo's own, integrated by the scheme that mujoco.sysid uses here: an advantage
that no robot would give it. It takes minutes, so it gets the cases of --toolbox only, and stops
after --seconds of CPU time of each with the best that it has.

Neither peer names a cause. What they say are numbers: told are those that change most from the
URDF's, by the torque that the change makes (least_squares) or by ratio (mujoco_sysid).

Every case is one line of `--raw`, with the version of the sources that made it.
"""

import argparse
import contextlib
import io
import os
import sys
import tempfile
from collections.abc import Sequence
from fnmatch import fnmatch
from functools import partial
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
from absl import logging
from base_parameters import least_squares
from case_rows import known_rows, with_missing
from mujoco import sysid
from outside import cpu_seconds
from robots import ROOT, Case, is_right, known_urdf, made, programme, version
from robots_machines import ROBOTS, Robot

from cg_dynamics.mechanisms.mechanism import Mechanism
from cg_dynamics.model import Model
from cg_sysid.checks.loading import load_bags
from cg_sysid.diagnosis.diagnose import split
from cg_sysid.identification.data_set import DataSet, led_in, pieces, prepare

logging.set_verbosity(logging.ERROR)  # our readings are computed from the state

ITERATIONS = 12  # of mujoco.sysid, each time
LENGTHS = 0.5, 2.0  # s, of the pieces that mujoco.sysid gets: longer ones run away at first
SETTLING = 3  # steps by which initial motions of records held out are fitted
LITTLE = 0.02  # of the cost: turns of numbers and initial motions that gain less are the last
FAR = 1e4  # residual in standard deviations where a simulation runs away
DIFFERENCE = 1e-4  # of numbers, for the toolbox: smaller ones drown in its constraint solver
STEP = 1e-4  # of differences by an initial motion, rad (m) and rad/s (m/s)
AT_NOISE = 1.3  # chi2/N
TOLD = 2  # numbers of each peer
SECONDS = 300.0  # of CPU time, for mujoco.sysid


def by_torques(model: Model, train: Sequence[DataSet], held: Sequence[DataSet]) -> dict[str, Any]:
    """What least squares are left with, by drive, and what they say."""
    found = least_squares(model, train, held)
    body = model.mechanism
    return {
        'left': dict(zip(body.driven, map(float, found.left), strict=True)),
        'says': dict(found.changed),
    }


class OutOfTime(Exception):
    """The CPU time of a peer is over."""


class Toolbox:
    """A robot as mujoco.sysid sees it: its URDF, and numbers that may differ.

    Args:
        robot: Its joints and links.
        urdf: As its owner has it.
        data_sets: Pieces of records.
        until: Of `cpu_seconds`, when a fit ends.
    """

    def __init__(self, robot: Robot, urdf: str, data_sets: Sequence[DataSet], until: float):
        self.robot, self.data_sets, self.until = robot, data_sets, until
        self.row = float(np.median(np.diff(data_sets[0].time)))
        self.spec = self._spec(urdf)
        self.model = self.spec.compile()
        self.motions = [data_set.motion.copy() for data_set in data_sets]
        self.parameters = self._parameters()
        self.urdfs = self.numbers()

    def _spec(self, urdf: str) -> mujoco.MjSpec:
        extension = (
            '<mujoco><compiler fusestatic="false" discardvisual="true" balanceinertia="false" '
            'boundmass="0" boundinertia="0"/></mujoco>'
        )
        spec = mujoco.MjSpec.from_string(urdf.replace('</robot>', f'{extension}</robot>'))
        spec.option.timestep = self.row
        spec.option.tolerance = 1e-10
        spec.option.integrator = mujoco.mjtIntegrator.mjINT_RK4
        spec.option.disableflags |= int(mujoco.mjtDisableBit.mjDSBL_CONTACT)
        for joint in spec.joints:
            joint.limited = mujoco.mjtLimited.mjLIMITED_FALSE
            joint.actfrclimited = mujoco.mjtLimited.mjLIMITED_FALSE
            # As hard as this step allows: the default gives way for 20 ms.
            joint.solref_friction = [2 * self.row, 1]
        for name in self.robot.driven:
            motor = spec.add_actuator(name=name, target=name)
            motor.trntype = mujoco.mjtTrn.mjTRN_JOINT
            motor.gainprm[0] = 1.0
        return spec

    def _parameters(self) -> sysid.ParameterDict:
        made = sysid.ParameterDict()
        for link in self.robot.links:
            made.add(sysid.body_inertia_param(self.spec.copy(), self.model, link))
        for name in self.robot.joints:
            dof = self.model.joint(name).dofadr[0]
            friction = float(self.model.dof_frictionloss[dof])
            scale = max(friction, 1e-2 * self._largest(name))
            damping = float(self.model.dof_damping[dof])
            inertia = self._inertia(dof)
            for attribute, start, most in (
                # Not from a bound, where the toolbox may stall.
                ('damping', max(damping, 0.1 * scale), 20 * max(damping, scale)),
                ('frictionloss', max(friction, 0.1 * scale), 20 * scale),
                ('armature', 0.05 * inertia, 2 * inertia),
            ):
                made.add(sysid.Parameter(
                    f'{name}: {attribute}', start, 0.0, most,
                    modifier=lambda spec, p, n=name, a=attribute: _put(spec.joint(n), a, p),
                ))  # fmt: skip
        for name in self.robot.driven:
            made.add(sysid.Parameter(
                f'{name}: gain', 1.0, 0.5, 2.0,
                modifier=lambda spec, p, n=name: _put(spec.actuator(n), 'gainprm', p),
            ))  # fmt: skip
        return made

    def _largest(self, joint: str) -> float:
        if joint not in self.robot.driven:
            return 1.0
        return max(float(np.abs(self._torque(d)[:, self.robot.driven.index(joint)]).max())
                   for d in self.data_sets)  # fmt: skip

    def _inertia(self, dof: int) -> float:
        data, whole = mujoco.MjData(self.model), np.zeros((self.model.nv, self.model.nv))
        mujoco.mj_forward(self.model, data)
        mujoco.mj_fullM(self.model, data, whole)
        return float(whole[dof, dof])

    def _torque(self, data_set: DataSet) -> np.ndarray:
        return data_set.inputs_for([f'{joint}_effort' for joint in self.robot.driven])

    def numbers(self) -> dict[str, float]:
        """Those that a person reads: masses, and what joints and drives have."""
        spec = self.spec.copy()
        for name in self.parameters.keys():
            self.parameters[name].apply_modifier(spec)
        model = spec.compile()
        masses = {f'{link}: mass': float(model.body(link).mass[0]) for link in self.robot.links}
        own = {n: float(self.parameters[n].value[0]) for n in self.parameters.keys() if ':' in n}
        return masses | own

    def residuals(self, x: np.ndarray, parameters, motions=None) -> list[np.ndarray]:
        """Of all windows over noise, (samples,) each, or (samples, columns) of x of as many."""
        columns = x.reshape(len(x), -1)
        found: list[list[np.ndarray]] = []
        motions = self.motions if motions is None else motions
        for column in columns.T:
            parameters.update_from_vector(column)
            spec = self.spec.copy()
            for name in parameters.keys():
                parameters[name].apply_modifier(spec)
            model = spec.compile()
            found.append([
                self._residual(model, data_set, motion)
                for data_set, motion in zip(self.data_sets, motions, strict=True)
            ])  # fmt: skip
        stacked = [np.stack(each, axis=-1) for each in zip(*found, strict=True)]
        return [s[:, 0] for s in stacked] if x.ndim == 1 else stacked

    def _residual(self, model, data_set: DataSet, motion: np.ndarray) -> np.ndarray:
        data, m = mujoco.MjData(model), len(self.robot.joints)
        place = [model.joint(name).qposadr[0] for name in self.robot.joints]
        data.qpos[place], data.qvel[place] = motion[:m], motion[m:]
        start = np.empty(mujoco.mj_stateSize(model, mujoco.mjtState.mjSTATE_FULLPHYSICS))
        mujoco.mj_getState(model, data, start, mujoco.mjtState.mjSTATE_FULLPHYSICS)
        torque = self._torque(data_set)
        states, _ = mujoco.rollout.rollout(model, data, start[None], torque[None, :-1])
        simulated = np.vstack([motion[:m], states[0, :, 1 : 1 + model.nq][:, place]])
        r = (simulated - data_set.outputs[:, :m]) / data_set.sigma[:m]
        r = np.nan_to_num(r, nan=FAR, posinf=FAR, neginf=-FAR).clip(-FAR, FAR)
        return np.where(np.isfinite(data_set.outputs[:, :m]), r, 0.0).ravel()

    def fit(self) -> None:
        """Numbers by the toolbox and initial motions by Gauss-Newton, in turns."""
        best = self.parameters.as_vector()
        cost = np.inf

        def tried(x, parameters):
            nonlocal best, cost
            if cpu_seconds() > self.until:
                raise OutOfTime
            found = self.residuals(x, parameters)
            if x.size == len(best) and (now := sum(float(np.sum(r**2)) for r in found)) < cost:
                best, cost = x.ravel().copy(), now
            return found, [], []

        gained = True
        while gained:
            self.settle()
            before, cost = cost, np.inf
            with contextlib.suppress(OutOfTime):
                sysid.optimize(
                    self.parameters, tried, optimizer='mujoco', verbose=False,
                    max_iters=ITERATIONS, eps=DIFFERENCE, xtol=1e-6, output=io.StringIO(),
                )  # fmt: skip
            gained = cost < (1 - LITTLE) * before and cpu_seconds() < self.until
            self.parameters.update_from_vector(best)
        self.settle()

    def settle(self) -> None:
        """Initial motions of all windows, for the numbers as they are; none gets worse."""
        x, p = self.parameters.as_vector(), self.parameters
        here = self.residuals(x, p)
        slopes = []
        for c in range(len(self.motions[0])):
            moved = [motion + STEP * (np.arange(len(motion)) == c) for motion in self.motions]
            there = self.residuals(x, p, moved)
            slopes.append([(a - b) / STEP for a, b in zip(there, here, strict=True)])
        tried = [
            motion - np.linalg.lstsq(np.column_stack(by), r, rcond=1e-12)[0]
            for motion, r, by in zip(self.motions, here, zip(*slopes, strict=True), strict=True)
        ]
        there = self.residuals(x, p, tried)
        self.motions = [
            new if b @ b < a @ a else old
            for old, new, a, b in zip(self.motions, tried, here, there, strict=True)
        ]

    def error(self) -> float:
        """chi2/N, with the initial motions as they are."""
        found = self.residuals(self.parameters.as_vector(), self.parameters)
        return sum(float(r @ r) for r in found) / sum(
            int(np.isfinite(d.outputs).sum()) for d in self.data_sets
        )

    def judged(self, held: Sequence[DataSet], urdf: str) -> float:
        """chi2/N of records held out, of which the initial motions alone are fitted."""
        other = Toolbox(self.robot, urdf, held, np.inf)
        other.parameters.update_from_vector(self.parameters.as_vector())
        for _ in range(SETTLING):
            other.settle()
        return other.error()

    def says(self) -> dict[str, float]:
        """Number -> its ratio to the URDF's, or itself where the URDF has none."""
        return {
            name: value / self.urdfs[name] if self.urdfs[name] else value
            for name, value in self.numbers().items()
            if 'armature' not in name
        }


def _put(element, attribute: str, parameter) -> None:
    value = float(parameter.value[0])
    if attribute == 'gainprm':
        element.gainprm = [value, *[0.0] * 9]
    elif attribute == 'damping':
        element.damping = [value, 0.0, 0.0]
    else:
        setattr(element, attribute, value)


def peers_of(case: Case, of: str, seconds: float, toolbox: bool) -> dict[str, Any]:
    """One line of the raw results.

    Args:
        case: The machine.
        of: Version of the sources.
        seconds: CPU time for mujoco.sysid.
        toolbox: Whether it runs.
    """
    robot = ROBOTS[case.robot]
    with tempfile.TemporaryDirectory() as folder:
        file, bags, _ = made(case, Path(folder))
        model, loaded = Model.load(file), load_bags(bags, file)
    row: dict[str, Any] = {'case': case.name, 'site': case.site, 'version': of}
    if loaded.left_out:
        return row | {'left_out': [f'{s.name}: {s.reason}' for s in loaded.left_out]}
    train, held = split([led_in(d) for d in prepare(model, loaded.records)])
    began = cpu_seconds()
    row['least_squares'] = by_torques(model, train, held)
    row['least_squares']['cpu_s'] = round(cpu_seconds() - began, 2)
    if toolbox:
        began = cpu_seconds()
        row['mujoco_sysid'] = by_toolbox(model, robot, known_urdf(case), train, held, seconds)
        row['mujoco_sysid']['cpu_s'] = round(cpu_seconds() - began, 1)
    return row


def by_toolbox(
    model: Model,
    robot: Robot,
    urdf: str,
    train: Sequence[DataSet],
    held: Sequence[DataSet],
    seconds: float,
) -> dict[str, Any]:
    """What mujoco.sysid is left with, and what it says."""
    begun, judged = None, in_pieces(model.mechanism, held, LENGTHS[-1])
    began, before = cpu_seconds(), None
    for k, length in enumerate(LENGTHS, 1):
        until = began + k * seconds / len(LENGTHS)
        toolbox = Toolbox(robot, urdf, in_pieces(model.mechanism, train, length), until)
        if begun is None:
            before = toolbox.judged(judged, urdf)
        else:
            toolbox.parameters.update_from_vector(begun.parameters.as_vector())
        toolbox.fit()
        begun = toolbox
    return {'before': before, 'after': begun.judged(judged, urdf), 'says': begun.says()}


def in_pieces(body: Mechanism, data_sets: Sequence[DataSet], length: float) -> list[DataSet]:
    """All of them cut into pieces of so many seconds, each with a motion of its own."""
    return [piece for d in data_sets for _, piece in pieces(body, d, length)]


def largest(says: dict[str, float]) -> str:
    """What least squares change most, in words."""
    ordered = sorted(says.items(), key=lambda item: -item[1])[:TOLD]
    return ', '.join(f'{name} ({value:.1%})' for name, value in ordered)


def farthest(says: dict[str, float]) -> str:
    """Numbers that mujoco.sysid moved farthest, in words."""

    def moved(value: float) -> float:
        return abs(np.log(max(value, 1e-6)))

    ordered = sorted(says.items(), key=lambda item: -moved(item[1]))[:TOLD]
    return ', '.join(f'{name} x {value:.2g}' for name, value in ordered)


def table_of(rows: list[dict[str, Any]], ours: dict[str, dict[str, Any]]) -> list[str]:
    """A line for each case."""
    lines = [
        '| case | where | ours: causes | chi2/N: identified, with causes | CPU s '
        '| least squares: torque left, worst drive | changed most (share of torques) '
        '| mujoco.sysid: chi2/N: file, found | moved most | CPU s |',
        '|---|---|---|---:|---:|---:|---|---:|---|---:|',
    ]
    for row in rows:
        own = ours.get(row['case'], {})
        causes = ', '.join(own.get('causes', ())) or own.get('verdict', 'not run')
        wrong = ' (wrong)' if own and not is_right(own) else ''
        errors = f'{own["before"]:.3g}, {own["after"]:.3g}' if 'after' in own else ''
        line = (
            f'| {row["case"]} | {row["site"]} | {causes}{wrong} | {errors} '
            f'| {round(own["cpu_s"]) if own else ""} '
        )
        if plain := row.get('least_squares'):
            line += f'| {max(plain["left"].values()):.1%} | {largest(plain["says"])} '
        else:
            line += '| | recording refused by the check '
        if theirs := row.get('mujoco_sysid'):
            line += (f'| {theirs["before"]:.3g}, {theirs["after"]:.3g} | '
                     f'{farthest(theirs["says"])} | {theirs["cpu_s"]:.0f} |')  # fmt: skip
        else:
            line += '| | | |'
        lines.append(line)
    both = [
        (ours[row['case']]['after'], row['mujoco_sysid']['after'])
        for row in rows
        if 'mujoco_sysid' in row and 'after' in ours.get(row['case'], {})
    ]
    if both:
        at_noise = (np.array(both) < AT_NOISE).sum(0)
        lines += ['', f'Down to the noise (chi2/N below {AT_NOISE}) where both ran: ours '
                  f'{at_noise[0]} of {len(both)}, mujoco.sysid {at_noise[1]}. Its chi2/N is of '
                  f'pieces of {LENGTHS[-1]:g} s, an easier measure than ours.']  # fmt: skip
    return lines


def told(row: dict[str, Any]) -> str:
    """A row for the screen."""
    words = [row['case']]
    if 'least_squares' in row:
        words.append(largest(row['least_squares']['says']))
    if 'mujoco_sysid' in row:
        words.append(f'mujoco.sysid {row["mujoco_sysid"]["after"]:.4g}')
    return ' '.join(words)


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument('patterns', nargs='*', default=['*'], help="such as 'arm2:*'")
    parser.add_argument('--toolbox', default='', help='cases that mujoco.sysid gets, by a pattern')
    parser.add_argument('--seconds', type=float, default=SECONDS,
                        help=f'of CPU time, for mujoco.sysid [{SECONDS:g}]')  # fmt: skip
    parser.add_argument('--workers', type=int, default=os.cpu_count(), help='cases side by side')
    parser.add_argument('--ours', type=Path, default=ROOT / 'bench/results/robots.jsonl')
    parser.add_argument('--raw', type=Path, default=ROOT / 'build' / 'robots_peers.jsonl')
    parser.add_argument('--table-only', action='store_true', help='of the last version in --raw')
    parser.add_argument('--write', type=Path)
    options = parser.parse_args()
    of = version()
    cases = [c for c in programme() if any(fnmatch(c.name, p) for p in options.patterns)]
    rows = known_rows(options.raw, None if options.table_only else of)
    if not options.table_only:
        for toolbox in (True, False):
            own = [c for c in cases if fnmatch(c.name, options.toolbox) == toolbox]
            done = {n: r for n, r in rows.items() if not toolbox or 'mujoco_sysid' in r}
            rows |= with_missing(
                done, own, partial(peers_of, toolbox=toolbox), of, options.raw, options.workers,
                options.seconds, told,
            )  # fmt: skip
    shown = [rows[case.name] for case in cases if case.name in rows]
    if not shown:
        print('no rows of these sources', file=sys.stderr)
        return 1
    ours = known_rows(options.ours, None)
    lines = table_of(shown, ours)
    print('\n'.join(lines))
    if options.write:
        versions = {row['version'] for row in ours.values()} | {shown[0]['version']}
        options.write.write_text('\n'.join([
            '# The diagnosis and its peers on robots of a URDF', '',
            f'Command: `./cg exec python bench/robots_peers.py {" ".join(options.patterns)}`, '
            f'with `--toolbox {options.toolbox!r} --seconds {options.seconds:g}`; this table of '
            'its rows: the same with `--table-only --write FILE`. The diagnoses are those of '
            '`bench/robots.py`, on both cores each, with the CPU time of all workers. Sources '
            f'{", ".join(sorted(versions))}.',
            'What the peers are and get is written at the head of the bench.', '', *lines, '',
        ]))  # fmt: skip
    return 0


if __name__ == '__main__':
    sys.exit(main())
