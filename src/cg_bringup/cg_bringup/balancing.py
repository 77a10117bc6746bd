"""The balancing loop in lock-step, without ROS: the very classes that the nodes run.

    machine -> estimator -> controller -> torque gate -> machine

once per sample, as interfaces.md ("Lock-step") says of the nodes. Benches and tests run this.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from cg_control.balancing.balance import BALANCING, BalanceController
from cg_control.trees.recovery import TreeController
from cg_dynamics.errors import SimulationError
from cg_dynamics.mechanisms.compass_gait import CompassGait
from cg_dynamics.plant import Plant
from cg_dynamics.rig import STANCES, Setup
from cg_estimation.estimator import Estimator
from cg_hardware.safety import GateSettings, TorqueGate
from cg_interfaces import channels
from cg_interfaces.stamps import NS_PER_S
from cg_sysid.records.raw import NOTE_FORMAT
from cg_sysid.records.record import Record

FALLEN = 0.6  # rad of the stance leg: nothing catches the robot from there


@dataclass(frozen=True)
class BalanceRun:
    """A run of the loop, one row per sample.

    Attributes:
        time: In s, shape (n,).
        states: True states, shape (n, nx).
        estimates: What the controller was told, shape (n, 4 or more).
        torque: What the drive latched, N m, shape (n,).
        readings: Channel -> what the sensors reported, shape (n,).
        engaged: Whether the controller was balancing, shape (n,).
        standing: Index of the stance leg, shape (n,).
    """

    time: np.ndarray
    states: np.ndarray
    estimates: np.ndarray
    torque: np.ndarray
    readings: dict[str, np.ndarray]
    engaged: np.ndarray
    standing: np.ndarray

    @property
    def lean(self) -> np.ndarray:
        """Lean of the stance leg in rad, shape (n,)."""
        return self.states[np.arange(len(self.states)), self.standing]

    def upright(self, duration: float) -> bool:
        """True if the run lasted that many s, engaged to the end, and ends upright."""
        tail = self.time > self.time[-1] - 0.5
        return bool(
            self.time[-1] > duration - 0.01
            and self.engaged[tail].all()
            and np.abs(self.lean[tail]).max() < 0.2
        )


def balance(
    plant: Plant,
    estimator: Estimator,
    controller: BalanceController | TreeController,
    duration: float,
    pushes: Sequence[tuple[float, float]] = (),
) -> BalanceRun:
    """Run the loop until time is over or the robot lies.

    Args:
        plant: The machine.
        estimator: Told the readings and the torque that was latched.
        controller: Told the estimate.
        duration: In s.
        pushes: Instants in s and horizontal impulses in N s at the hip.
    """
    gate = TorqueGate(GateSettings(torque_limit=controller.torque_limit), ('hip',))
    rows: list[tuple] = []
    torque = 0.0
    hits = {round(instant * 1e9 / plant.sample_ns): impulse for instant, impulse in pushes}
    for tick in range(round(duration * 1e9 / plant.sample_ns)):
        if tick in hits:
            plant.push(hits[tick])
        measurement = plant.measure()
        now = measurement.time_ns
        standing = STANCES.index(plant.stance)
        estimate = estimator.step(now, torque, measurement.outputs, plant.stance)
        command = controller.step(now, estimate.stance, estimate.x)
        gate.offer([command.torque], now, now)
        (torque,) = gate.torque(now).torque
        rows.append(
            (
                now * 1e-9, plant.state, estimate.x, torque, measurement.outputs,
                controller.mode, standing,
            )
        )  # fmt: skip
        plant.latch(np.array([torque]))
        try:
            plant.advance()
        except SimulationError:
            break
        if abs(plant.state[STANCES.index(plant.stance)]) > FALLEN:
            break
    time, states, estimates, torques, readings, modes, legs = zip(*rows, strict=True)
    return BalanceRun(
        np.array(time),
        np.array(states),
        np.array(estimates),
        np.array(torques),
        {c: np.array([r[c] for r in readings]) for c in readings[0]},
        np.array([mode == BALANCING for mode in modes]),
        np.array(legs),
    )


def record_of(name: str, run: BalanceRun, setup: Setup) -> Record:
    """What a recorder would have kept of a run: readings, the latched torque, and a note.

    Args:
        name: Of the record.
        run: At least two samples long.
        setup: Names the leg that stood at the start; the steps are in the data.
    """
    stamps = np.round(run.time * NS_PER_S).astype(np.int64)
    note = {
        'format': NOTE_FORMAT,
        'experiment': name,
        'mechanism': CompassGait.name,
        'setup': setup.to_dict(),
        'nominal_rate_hz': float(1.0 / np.median(np.diff(run.time))),
        'initial_state': 'moving',
        'closed_loop': True,
    }
    robot = channels.mechanism(CompassGait.name)
    torques = {CompassGait.inputs[0]: run.torque}
    return Record(name, stamps, torques, run.readings, robot, setup, note)


def power_above(torque: np.ndarray, sample_time: float, frequency: float) -> float:
    """RMS in N m of the part of a torque above a frequency in Hz."""
    if len(torque) < 2:
        return 0.0
    spectrum = np.abs(np.fft.rfft(torque - torque.mean())) ** 2
    high = np.fft.rfftfreq(len(torque), sample_time) > frequency
    return float(np.sqrt(2.0 * spectrum[high].sum()) / len(torque))
