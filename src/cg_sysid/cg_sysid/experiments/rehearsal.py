"""Rehearsal: what an experiment would record, without ROS and without waiting.

The same simulated machine as on the live system, driven by the same excitation; only the topics
in between are left out. For tests, benches, and for asking what an experiment would show.
"""

from collections.abc import Callable, Sequence

import numpy as np

from cg_dynamics.model import Model
from cg_dynamics.plant import Plant
from cg_dynamics.rig import Setup
from cg_interfaces.channels import interface
from cg_sysid.records.record import Record

Signal = Callable[[float], float]


def rehearse(
    name: str,
    machine: Model,
    setup: Setup,
    initial_state: Sequence[float],
    torques: Sequence[Signal],
    duration: float,
    sample_time: float = 0.002,
    seed: int = 0,
) -> Record:
    """The record of one experiment on a simulated machine.

    Args:
        name: Name of the record.
        machine: Model of the machine, with whatever is hidden in it.
        setup: What is done to the rig.
        initial_state: Free coordinates in rad, then their rates in rad/s.
        torques: One signal of time in s per input, in N m.
        duration: In s.
        sample_time: In s.
        seed: Of the sensor noise.
    """
    plant = Plant(machine, setup, np.array(initial_state, float), sample_time, seed)
    rows = round(duration / sample_time)
    inputs = np.empty((rows, len(torques)))
    outputs: dict[str, list[float]] = {channel: [] for channel in machine.mechanism.outputs}
    stamps = np.empty(rows, np.int64)
    for k in range(rows):
        plant.latch(np.array([signal(k * sample_time) for signal in torques]))
        measured = plant.measure()
        stamps[k] = measured.time_ns
        inputs[k] = measured.applied
        for channel, value in measured.outputs.items():
            outputs[channel].append(value)
        plant.advance()
    note = {
        'format': 'cg_recording/1',
        'experiment': name,
        'mechanism': machine.mechanism.name,
        'setup': setup.to_dict(),
        'nominal_rate_hz': 1 / sample_time,
        'initial_state': 'moving',
    }
    return Record(
        name=name,
        stamp_ns=stamps,
        inputs=dict(zip(machine.mechanism.inputs, inputs.T, strict=True)),
        outputs={channel: np.array(values) for channel, values in outputs.items()},
        mechanism=interface(machine.mechanism),
        setup=setup,
        note=note,
    )
