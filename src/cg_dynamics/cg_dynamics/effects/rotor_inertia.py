"""Inertia of the motor's rotor, seen through the gear."""

from cg_dynamics.effects.effect import Effect
from cg_dynamics.parameter import Parameter


class RotorInertia(Effect):
    """T = J rate^2 / 2 with the rate of the joint."""

    name = 'rotor_inertia'
    place = 'transmission'
    summary = 'The rotor turns with the joint: T = J rate^2 / 2, J seen through the gear.'
    parameters = (
        Parameter(
            'inertia', 'kg m^2', 'of the rotor, times the squared gear ratio', 0.0, 10.0,
            neutral=0.0, starts=(0.001, 0.05), scale=0.001,
        ),
    )  # fmt: skip

    @classmethod
    def sites(cls, mechanism):
        """Drives, and motors behind a coupling whose joints tell the torques."""
        return tuple(dict.fromkeys((*mechanism.joints, *mechanism.couplings)))

    def energies(self, body, p):
        """Kinetic energy of the rotor."""
        row = body.mechanism.all_joints[self.site]
        rate = sum(b * body.v[i] for i, b in enumerate(row))
        return p['inertia'] * rate**2 / 2, 0
