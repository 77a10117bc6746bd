"""A spring of the set-up that is not as stiff as stated."""

import casadi as ca

from cg_dynamics.effects.effect import SpringEffect
from cg_dynamics.parameter import Parameter


class SpringStiffness(SpringEffect):
    """One spring pulls with (1 + error) times its stated stiffness."""

    name = 'spring_stiffness'
    summary = 'A spring of the set-up is stiffer than stated: force (1 + error) stiffness s.'
    parameters = (
        Parameter(
            'error', '1', 'true over stated stiffness, less 1', -0.9, 9.0,
            neutral=0.0, starts=(0.05,), scale=0.01,
        ),
    )  # fmt: skip

    @classmethod
    def sites(cls, mechanism):
        """The springs of a set-up in their order; a pair is the most that is told apart."""
        return ('spring0', 'spring1') if super().sites(mechanism) else ()

    def energies(self, body, p):
        """What is missing of its potential."""
        springs = body.springs()
        index = int(self.site.removeprefix('spring'))
        if index >= len(springs):
            return 0, ca.SX(0)
        stretch, stiffness = springs[index]
        return 0, p['error'] * stiffness * stretch**2 / 2
