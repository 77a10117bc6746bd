"""A robot in memory: a simulated body, a gate and a drive, and time of its own. For tests."""

import numpy as np

from cg_dynamics.model import Model
from cg_dynamics.plant import Plant
from cg_dynamics.rig import Setup
from cg_hardware.checklist.measuring import Series
from cg_hardware.checklist.robot import Device, Refused, Skipped
from cg_hardware.lifecycle import Lifecycle, Signs
from cg_interfaces import topics

STEP = 0.002
START = 10**18
LIMIT = 40.0
STALE = {'drive': 0.015, 'safety_gate': 0.1}
CHANNELS = (
    'imu_angle', 'imu_rate', 'hip_angle', 'applied', 'command', 'enabled', 'inner_foot',
    'outer_foot',
)  # fmt: skip


class RobotInMemory:
    """What a person finds wrong is set by its attributes.

    Attributes:
        drive_sign: -1 where the torque turns the joint backward.
        count_sign: -1 where the encoder counts backward.
        imu_sign: -1 where the lean counts backward.
        inertia: Torque of the motor per torque that the drive tells, inverse.
        deaf: Whether the emergency stop is not heard.
        clips: Whether the gate clips.
        rate: Of the IMU in Hz.
        feet: Whether there are foot switches.
        willing: Whether the person does what is asked.
    """

    def __init__(self, model=None):
        self.emulated = True
        self.model = model or Model.load('compass_gait_mit')
        self.plant = Plant(self.model, Setup(fixture='inner_fixed'), sample_time=STEP, seed=3)
        self.drive_sign = self.count_sign = self.imu_sign = 1.0
        self.inertia, self.deaf, self.clips, self.feet = 1.0, False, True, True
        self.drift, self.willing, self.hung = 40.0, True, True
        self.gate = Lifecycle(arming=True)
        self.limit, self.tick = LIMIT, 0
        self.torque = self.asked = None
        self.asked_at = -1.0
        self.enabled = False
        self.silent = set()
        self.left = False
        self.orders, self.leant, self.lean_to = [], 0.0, 0.0
        self.pressed = {'inner': 1.0, 'outer': 0.0}
        self.found = ''
        self.finding = False
        self.zeros = {'imu': 0.01, 'hip': 0.02}
        self.heard = {name: [] for name in CHANNELS}
        self.rests, self.changed, self.zero = 0, [], ''
        self.zeroed_at = '2026-03-04T10:05:00Z'
        self.said = []

    @property
    def stage(self):
        return self.gate.line

    def now_ns(self):
        return START + round(self.tick * STEP * 1e9)

    def say(self, text):
        self.said.append(text)

    def ask(self, text, hands=()):
        if not self.willing:
            raise Skipped('nobody answers')
        self.orders += [(self.tick * STEP + after, words) for after, words in hands]

    def obey(self):
        due = [words for at, words in self.orders if at <= self.tick * STEP]
        self.orders = [order for order in self.orders if order[0] > self.tick * STEP]
        for words in due:
            word, *rest = words.split()
            if word == 'lean':
                self.lean_to = float(rest[0])
            elif word.startswith('foot'):
                self.pressed[word[5:]] = float(rest[0])
            elif word.endswith('unplug'):
                self.silent.add(word[:3])
            else:
                self.silent.discard(word[:3])

    def step(self):
        """One cycle of gate, drive and sensors."""
        self.obey()
        now = self.tick * STEP
        if self.torque is not None and 'imu' not in self.silent and not self.left:
            self.asked, self.asked_at = self.torque(now - self.since), now
        fresh = self.asked is not None and now - self.asked_at <= STALE['safety_gate']
        silent = tuple(name for name, short in (('imu', 'imu'), ('drive', 'can'))
                       if short in self.silent)  # fmt: skip
        self.gate.see(Signs(silent=silent, requests=fresh))
        command = 0.0
        if self.asked is not None and self.gate.passes:
            limit = self.limit if self.clips else 1e9
            command = min(max(self.asked, -limit), limit)
        young = now - self.asked_at <= STALE['drive']
        if 'can' in self.silent:
            self.enabled = False
        applied = command if self.enabled and young else 0.0
        self.plant.latch(np.array([self.drive_sign * applied / self.inertia]))
        self.plant.advance()
        step = min(max(self.lean_to - self.leant, -STEP), STEP)
        self.leant += step
        outputs = self.plant.measure().outputs
        lean = self.imu_sign * (outputs['imu_angle'] + self.leant)
        if self.finding and abs(self.leant) > 0.2:
            self.found, self.finding = f'pitch {self.imu_sign:+g}', False
        hip = self.count_sign * (outputs['hip_angle'] + self.leant)
        values = {
            'imu_angle': lean - self.zeros['imu'],
            'imu_rate': self.imu_sign * (outputs['imu_rate'] + step / STEP),
            'hip_angle': hip - self.zeros['hip'], 'applied': applied, 'command': command,
            'enabled': float(self.enabled),
            'inner_foot': self.pressed['inner'], 'outer_foot': self.pressed['outer'],
        }  # fmt: skip
        self.tick += 1
        self.raw = {'imu': lean, 'hip': hip}
        for name, value in values.items():
            if ('imu' if name.startswith('imu') else 'can') in self.silent:
                continue
            if name.endswith('foot') and not self.feet:
                continue
            self.heard[name].append((self.now_ns(), value))

    def listen(self, seconds, torque=None, until=None, more=False):
        if not more:
            self.heard = {name: [] for name in CHANNELS}
        self.torque, self.since = torque, self.tick * STEP
        for k in range(round(seconds / STEP)):
            self.step()
            if until is not None and k % 25 == 0 and until(self.series()):
                break
        return self.series()

    def series(self):
        found = {}
        for name, rows in self.heard.items():
            stamps = np.array([row[0] for row in rows], np.int64)
            values = np.array([row[1] for row in rows], float)
            found[name] = Series(stamps, stamps + 1_000_000, values)
        return found

    def publishers_of(self, topic):
        if topic.startswith(topics.FOOT_CONTACT[:10]) and not self.feet:
            return []
        return ['imu'] if topic == topics.IMU else ['drive']

    def device(self, name):
        if name != 'imu':
            told = {'zeroed_at': self.zeroed_at, 'zero': self.zero}
            return Device('silent', True, told, 'node 1')
        return Device('sampling', True, {
            'clock_drift_ppm': f'{self.drift}', 'clock_jumps': '0', 'axis': 'pitch',
            'sign': '+1', 'found': self.found, 'model': 'GX3', 'serial': '7',
            'zeroed_at': '2026-03-04T10:00:00Z', 'zero_rad': '0.010000',
        })  # fmt: skip

    def setting(self, node, name):
        known = {'rate_hz': 500.0, 'sample_rate_hz': 500.0, 'stale_after': STALE.get(node)}
        if name not in known:
            raise Refused(f'{node} has no parameter {name}')
        return known[name]

    def change(self, node, name, value):
        assert node == 'safety_gate'
        self.changed.append(name)
        if name == 'torque_limit':
            self.limit = value

    def press(self, button):
        if button == '/imu/zero':
            self.zeros['imu'] = self.raw['imu']
        elif button == '/drive/zero':
            self.zeros['hip'] = self.raw['hip']
        elif button == '/imu/find_axis':
            self.finding, self.found = True, ''
        elif button == '/safety_gate/stop':
            self.stop_by_topic()
        elif button == '/safety_gate/arm':
            if problem := self.gate.arm():
                raise Refused(problem)
        return ''

    def stop_by_topic(self):
        if not self.deaf:
            self.gate.stop()

    def leave(self):
        self.left = True

    def take_control(self):
        self.step()
        self.press('/safety_gate/arm')
        self.enabled = True

    def rest(self):
        self.rests += 1
        self.torque = self.asked = None
        self.left = self.enabled = False
        self.gate.disarm()
        self.gate.reset()
        self.limit = LIMIT
