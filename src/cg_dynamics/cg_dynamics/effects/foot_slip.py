"""Ground that is too slippery to walk on."""

from dataclasses import replace

from cg_dynamics.effects.effect import LandingEffect
from cg_dynamics.parameter import Parameter


class FootSlip(LandingEffect):
    """|F_t| <= mu F_n of impulses and forces; a foot that slides has F_t = -mu F_n sgn(slip)."""

    name = 'foot_slip'
    summary = (
        "A foot that lands or stands slides where the ground's force would leave Coulomb's "
        'cone: |F_t| <= mu F_n.'
    )
    parameters = (
        Parameter(
            'friction', '1', 'mu, coefficient of Coulomb friction', 0.01, 5.0,
            neutral=float('inf'), starts=(0.3, 0.15, 0.6), free=False, scale=0.02,
            logarithmic=True,
        ),
    )  # fmt: skip

    def landing(self, law, p):
        """The foot is held by friction alone."""
        return replace(law, friction=p['friction'])
