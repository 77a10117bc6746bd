"""Somebody pushes the robot once."""

import math
from dataclasses import replace

import casadi as ca

from cg_dynamics.effects.effect import TIME, StanceEffect
from cg_dynamics.parameter import Parameter


class ExternalPush(StanceEffect):
    """A horizontal force at the hip, or any on a link, a pulse over the time of the record.

    A rectangle whose edges are smeared by a logistic density, with s its scale and w its length:

        F(t) = impulse (tanh((late + w/2) / 2s) - tanh((late - w/2) / 2s)) / 2w         (PUSH)
        late = t - instant
        s^2 = 3 roundness duration^2 / pi^2,  w^2 = 12 (1 - roundness) duration^2

    The variances of the two add up, so that `duration` is the standard deviation of the pulse for
    every `roundness`: a rectangle (0.1), a half sine (0.25), a bell (0.5) or a peak (0.9).

    A push is an event of a record, not a property of the machine: every record has its own
    impulse and instant, and most have none.

    Where on a link of a robot somebody pushes, and which way, its joints do not tell apart. They
    tell the torque that the push has about each of them, from the link to the base, and of that
    the impulse: one for each joint. While the robot moves its lever about a joint changes, to
    first order by

        torque(t) = F(t) / impulse (impulse_joint + growth_joint (t - instant) / duration)  (LEVER)

    About the nearest joint that is another instant only.
    """

    name = 'external_push'
    summary = (
        'Something pushes the hip forward, or a link of a robot, once: a smooth pulse of force '
        'around an instant, with a given impulse; both are found for each record.'
    )
    contains = ('tether_force',)
    parameters = (
        Parameter(
            'impulse', 'N s', 'integral of the force, positive forward', -200.0, 200.0,
            neutral=0.0, starts=(0.5,), scale=0.1, each='record',
        ),
        Parameter(
            'instant', 's', 'time of the greatest force from the start of the record', 0.0, 600.0,
            starts=(0.5,), scale=0.005, each='record',
        ),
        Parameter(
            'duration', 's', 'standard deviation of the pulse in time', 0.002, 2.0,
            starts=(0.1,), scale=0.02, logarithmic=True, ends=('lower',),
        ),
        Parameter(
            'roundness', '1', 'share of the squared duration that is in the edges', 0.1, 0.9,
            starts=(0.5,), scale=0.1, free=False, leeway=0.4,
        ),
    )  # fmt: skip
    extra_inputs = (TIME,)
    largest_step = 0.002

    @classmethod
    def sites(cls, mechanism):
        """The hip of a compass gait; the links of a robot."""
        return mechanism.bodies if mechanism.dimensions == 3 else super().sites(mechanism)

    def parameters_in(self, mechanism):
        """At a link an impulse about each joint that carries it, the nearest first."""
        if mechanism.dimensions == 2:
            return self.parameters
        impulse, *others = self.parameters
        joints = mechanism.joints_to(self.site)[::-1]

        def about(joint, name, description):
            unit = 'N s' if mechanism.slides(joint) else 'N m s'
            return replace(
                impulse, name=f'{name}_{joint}', unit=unit, description=f'{description} {joint}'
            )

        return (
            *(about(joint, 'impulse', 'integral of what it does to') for joint in joints),
            *(about(joint, 'growth', 'what more of it a `duration` later does to')
              for joint in joints[1:]),
            *others,
        )  # fmt: skip

    def torques(self, values):
        """Torque about each joint of a robot during the pulse, on average: joint -> N m (N)."""
        length = math.sqrt(12) * values['duration']
        impulses = {n: v for n, v in values.items() if n.startswith('impulse_')}
        return {n.removeprefix('impulse_'): v / length for n, v in impulses.items()}

    def acts(self, values):
        """Where any impulse is not 0."""
        return any(values[p.name] for p in self.parameters if p.neutral is not None)

    def force(self, body, z, p):
        """(PUSH) through the hip's Jacobian, or about each joint."""
        late, duration, round_ = p[TIME] - p['instant'], p['duration'], p['roundness']
        edge = 2 * duration * ca.sqrt(3 * round_) / math.pi
        length = duration * ca.sqrt(12 * (1 - round_))
        rise, fall = (ca.tanh((late + half) / edge) for half in (length / 2, -length / 2))
        pulse = (rise - fall) / (2 * length)
        if body.mechanism.dimensions == 3:
            about = [
                p.get(f'impulse_{name}', 0.0) + p.get(f'growth_{name}', 0.0) * late / duration
                for name in body.mechanism.coordinates
            ]
            return ca.vertcat(*about) * pulse, []
        hip, _ = body.hip()
        return ca.gradient(hip[0], body.q) * p['impulse'] * pulse, []
