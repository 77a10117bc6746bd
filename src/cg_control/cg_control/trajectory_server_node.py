"""ROS node of the trajectory server: it loads or plans, shows, starts and stops motions.

/trajectory/nominal   the selected motion as JointTrajectory, latched: for plots and people
/trajectory/selected  the same as the text of its file, with gains and model hash, latched
/trajectory           what is to be done now: a motion starts it, an empty one stops, as for
                      a joint_trajectory_controller

`trajectory` selects: `inner_to_outer` or `outer_to_inner` plan the one-step rebalance, anything
else is a file. ~/start and ~/stop are std_srvs/Trigger; ~/plan plans or loads again. A selection
that cannot be used is an error in the log and in the answer of ~/start, and nothing starts.
"""

from dataclasses import dataclass

from builtin_interfaces.msg import Duration
from rclpy.node import Node
from std_msgs.msg import String
from std_srvs.srv import Trigger
from trajectory_msgs.msg import JointTrajectory, JointTrajectoryPoint

from cg_control.following.planning import plan
from cg_control.trajectories.collocation import Options
from cg_control.trajectories.task import Task
from cg_control.trajectories.trajectory import Trajectory
from cg_description.paths import NOMINAL_MODEL, model_path
from cg_dynamics.model import Model
from cg_dynamics.rig import STANCES
from cg_interfaces.ros import LATCHED_QOS, SENSOR_QOS, DeclaredSettings, run
from cg_interfaces.settings import Settings, setting

PLANNED = {'inner_to_outer': ('inner', 'outer'), 'outer_to_inner': ('outer', 'inner')}


@dataclass(frozen=True)
class ServerSettings(Settings):
    """Parameters of the trajectory server."""

    model_file: str = setting(
        '', 'model to plan for, a file or a name; empty for the nominal compass gait'
    )
    trajectory: str = setting(
        'inner_to_outer',
        f'what is selected: {", ".join(PLANNED)} (planned), or a trajectory file',
        live=True,
    )
    friction: bool = setting(
        True, 'plan with friction; otherwise the controller compensates it', live=True
    )
    reach: float = setting(
        0.2, 'least length of the planned step', unit='m', minimum=0.02, maximum=1.0, live=True
    )
    torque_limit: float = setting(
        0.0, 'of the plan; 0 takes the limit of the model', unit='N m', minimum=0.0, live=True
    )
    intervals: int = setting(25, 'of a planned phase', minimum=4, maximum=200, live=True)
    save: str = setting('', 'file to write the selected trajectory to; empty for none', live=True)


class TrajectoryServerNode(Node):
    """Publishes /trajectory."""

    def __init__(self, **kwargs):
        super().__init__('trajectory_server', **kwargs)
        self.declared = DeclaredSettings(self, ServerSettings)
        path = self.declared.values.model_file or model_path(NOMINAL_MODEL)
        self.model = Model.load(path)
        self.trajectory: Trajectory | None = None
        self.problem = 'nothing selected yet'
        self._selected: ServerSettings | None = None
        self.nominal = self.create_publisher(JointTrajectory, '/trajectory/nominal', LATCHED_QOS)
        self.selected = self.create_publisher(String, '/trajectory/selected', LATCHED_QOS)
        self.order = self.create_publisher(JointTrajectory, '/trajectory', SENSOR_QOS)
        for name, answer in (('start', self.on_start), ('stop', self.on_stop),
                             ('plan', self.on_plan)):  # fmt: skip
            self.create_service(Trigger, f'~/{name}', answer)
        self.poll()

    def poll(self) -> float:
        """Follow the selection."""
        if self._selected is not self.declared.values:
            self._select()
        return 0.1

    def _select(self) -> None:
        settings = self._selected = self.declared.values
        try:
            self.trajectory = self._obtained(settings)
            if settings.save:
                self.trajectory.save(settings.save)
        except (ValueError, OSError) as error:
            self.trajectory, self.problem = None, str(error)
            self.get_logger().error(f'{settings.trajectory}: {error}')
            return
        self.problem = ''
        self.nominal.publish(joint_trajectory(self.trajectory))
        self.selected.publish(String(data=self.trajectory.text()))
        self.get_logger().info(
            f'{settings.trajectory}: {" -> ".join(self.trajectory.modes)} in '
            f'{self.trajectory.duration:.2f} s'
        )

    def _obtained(self, settings: ServerSettings) -> Trajectory:
        if settings.trajectory not in PLANNED:
            return Trajectory.load(settings.trajectory, self.model)
        task = Task(
            PLANNED[settings.trajectory],
            reach=settings.reach,
            torque_limit=settings.torque_limit or None,
        )
        return plan(self.model, task, Options(fine=settings.intervals), settings.friction)

    def on_start(self, request, response):
        """Start what is selected."""
        self.poll()
        if self.trajectory is None:
            response.success, response.message = False, self.problem
            return response
        self.order.publish(joint_trajectory(self.trajectory))
        response.success, response.message = True, self.declared.values.trajectory
        return response

    def on_stop(self, request, response):
        """Stop what runs."""
        self.order.publish(JointTrajectory(joint_names=list(STANCES)))
        response.success = True
        return response

    def on_plan(self, request, response):
        """Plan or load again."""
        self._select()
        response.success, response.message = not self.problem, self.problem
        return response

    def close(self) -> None:
        """Nothing runs on without its server."""
        self.order.publish(JointTrajectory(joint_names=list(STANCES)))


def joint_trajectory(trajectory: Trajectory) -> JointTrajectory:
    """The nominal motion: interfaces.md, "Trajectories"."""
    message = JointTrajectory(joint_names=list(STANCES))
    message.header.frame_id = f'{trajectory.modes[0]}_foot'
    start = trajectory.phases[0].start
    for phase in trajectory.phases:
        for t, x, dx, u in zip(phase.time, phase.states, phase.rates, phase.torque, strict=True):
            seconds, rest = divmod(round((t - start) * 1e9), 1_000_000_000)
            message.points.append(
                JointTrajectoryPoint(
                    positions=x[:2].tolist(),
                    velocities=x[2:4].tolist(),
                    accelerations=dx[2:4].tolist(),
                    effort=[float(u), -float(u)],
                    time_from_start=Duration(sec=seconds, nanosec=rest),
                )
            )
    return message


def main(args: list[str] | None = None) -> int:
    """Entry point of `ros2 run cg_control trajectory_server_node`."""
    return run(TrajectoryServerNode, ServerSettings, args)


if __name__ == '__main__':
    raise SystemExit(main())
