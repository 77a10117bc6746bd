"""A sole that is soft and wide rather than a point."""

from cg_dynamics.effects.effect import StanceEffect
from cg_dynamics.parameter import Parameter


class FootCompliance(StanceEffect):
    """V = stiffness q_st^2 / 2, q_st the lean of the leg that stands."""

    name = 'foot_compliance'
    family = ('outer_torque', 'angle')
    summary = (
        'A soft pad under the foot that stands holds the leg upright: -stiffness lean. '
        'How far it sinks in under the weight is left out.'
    )
    parameters = (
        Parameter(
            'stiffness', 'N m/rad', 'of the pad against leaning', 0.0, 500.0,
            neutral=0.0, starts=(1.0, 20.0), scale=0.5,
        ),
    )  # fmt: skip

    def energies(self, body, p):
        """A torsional spring at the foot."""
        return 0, p['stiffness'] * body.q[body.stance] ** 2 / 2
