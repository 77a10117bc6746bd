"""A link of a robot is pushed in MuJoCo, by a force at a point: which, when, and how much."""

import numpy as np
import pytest

pytest.importorskip('mujoco', reason='MuJoCo is not installed')

import mujoco
from hanging_arm import nominal, urdf
from mujoco_tree import SAMPLE, Secret, compiled, record, wander

from cg_interfaces import channels
from cg_sysid.diagnosis.diagnose import diagnose
from cg_sysid.diagnosis.result import Options
from cg_sysid.records.record import Record

JOINTS = ('hip_joint', 'thigh_joint', 'shank_joint')
OFF = {'damping': (0.23, 0.13, 0.12), 'dry': (0.17, 0.17, 0.09)}  # N m s/rad, N m; not as believed
POINT = (0.02, 0.03, -0.11)  # m, in the frame of the link
WIDTH = 0.12  # s, of a half sine
NOISE = 5e-5  # rad
SURELY = 3.3  # standard deviations: 99.9 % of intervals hold


class Push:
    """A force at a point of a link, as torques about the joints by the engine's own Jacobian."""

    def __init__(self, link, force, middle):
        self.force, self.middle = np.array(force), middle
        self.model = compiled(urdf(), Secret())
        self.data = mujoco.MjData(self.model)
        self.link = self.model.body(link).id
        self.place = [self.model.joint(name).dofadr[0] for name in JOINTS]

    def of(self, q):
        """Torque of each joint by a force of full strength, N m."""
        self.data.qpos[self.place] = q
        mujoco.mj_kinematics(self.model, self.data)
        mujoco.mj_comPos(self.model, self.data)
        body = self.data.body(self.link)
        jacobian = np.zeros((3, self.model.nv))
        mujoco.mj_jac(self.model, self.data, jacobian, None,
                      body.xpos + body.xmat.reshape(3, 3) @ POINT, self.link)  # fmt: skip
        return (jacobian.T @ self.force)[self.place]

    def __call__(self, time, q, v, torque):
        late = (time - self.middle) / WIDTH
        return self.of(q) * np.cos(np.pi * late) if abs(late) < 0.5 else np.zeros(len(q))

    def impulses(self, recording):
        """Integral of the torque about each joint along a recorded motion, N m s."""
        torques = [self(t, q, None, None) for t, q in
                   zip(recording.time, recording.position, strict=True)]  # fmt: skip
        return dict(zip(JOINTS, np.sum(torques, axis=0) * SAMPLE, strict=True))


def recorded(number, push=None):
    """Smooth ways under a controller that knows nothing of the robot."""
    secret = Secret(
        damping=dict(zip(JOINTS, OFF['damping'], strict=True)),
        dry=dict(zip(JOINTS, OFF['dry'], strict=True)), **({'torque': push} if push else {}),
    )  # fmt: skip
    way, start = wander(np.random.default_rng(number), 3, np.array([0.5, 0.8, 0.9]), 0.3, 1.5)

    def command(time, q, v):
        where, rate = way(time)
        return 60 * (where - q) + 3 * (rate - v)

    return record(urdf(), JOINTS, command, 5.0, start, secret, noise=NOISE, seed=number)


def as_record(name, number, recording):
    body = nominal().mechanism
    return Record(
        name=name,
        stamp_ns=1_700_000_000_000_000_000 + 60_000_000_000 * number
        + np.round(recording.time * 1e9).astype(np.int64),
        inputs=dict(zip(body.inputs, recording.effort.T, strict=True)),
        outputs=dict(zip(body.outputs, recording.position.T, strict=True)),
        mechanism=channels.interface(body),
    )  # fmt: skip


@pytest.mark.evidence
@pytest.mark.parametrize(
    ('link', 'force', 'joints'),
    [('shank', (9.0, -7.0, 4.0), JOINTS), ('thigh', (-14.0, 11.0, 3.0), JOINTS[:2])],
)
def test_the_link_that_is_pushed_is_named_with_what_its_joints_felt(link, force, joints):
    push = Push(link, force, 2.37)
    pushed = recorded(3, push)
    records = [as_record(f'ways_{k}', k, pushed if k == 3 else recorded(k)) for k in range(1, 5)]
    # Of the dry friction of MuJoCo the law is harder than that of the model.
    believed = nominal().with_values({f'coulomb_friction@{j}.transition_rate': 0.003
                                      for j in JOINTS})  # fmt: skip
    effects = ('external_push', 'torque_bias', 'payload', 'torque_constant', 'stribeck_friction')
    answer = diagnose(believed, records, Options(effects=effects, workers=1))
    (cause,) = answer.causes
    assert cause.label == f'external_push@{link}', answer.summary
    ((name, event),) = cause.events.items()
    assert name == 'ways_3'
    assert [n for n in event if n.startswith('impulse')] == [
        f'impulse_{joint}' for joint in reversed(joints)
    ]
    for joint, truth in push.impulses(pushed).items():
        value, sigma, unit = event.get(f'impulse_{joint}', (0.0, 0.0, 'N m s'))
        assert unit == 'N m s'
        assert value == pytest.approx(truth, abs=max(SURELY * sigma, 0.02 * abs(truth)))
    value, sigma, _ = event['instant']
    assert value == pytest.approx(2.37, abs=max(SURELY * sigma, 0.005))
