"""A landing that bounces."""

from dataclasses import replace

from cg_dynamics.effects.effect import LandingEffect
from cg_dynamics.parameter import Parameter


class ImpactRestitution(LandingEffect):
    """n . v+ = -e n . v- of the landing foot, n the ground's normal: theory.md, (NEWTON)."""

    name = 'impact_restitution'
    summary = (
        'The landing foot rebounds, with ever smaller bounces: its speed off the ground is '
        'e times the speed with which it came.'
    )
    parameters = (
        Parameter(
            'coefficient', '1', 'e, rebound speed over speed of approach', 0.0, 0.99,
            neutral=0.0, starts=(0.1, 0.3, 0.03, 0.6), free=False, scale=0.02,
        ),
    )  # fmt: skip

    def landing(self, law, p):
        """The foot rebounds."""
        return replace(law, restitution=p['coefficient'])
