"""ROS node of the tree server: it selects a tree, checks it, and shows what is done with it.

`tree` selects, the name of one that comes along or a file; ~/load (std_srvs/Trigger) takes the
file as it is now, after it was grown anew, and says whether it can be used. One that cannot be
used, of another model for instance, is an error in the log and in the answer of ~/load. The tree
before stays selected.

/tree/selected   path and SHA-256 of the file as JSON, latched: what the tree controller loads
/tree/node       from the tree controller: the node that it went over to, -1 outside the tree
/tree/branch     the way home from that node as JointTrajectory, latched; empty where there is none
/tree/markers    the same as lines of hip and feet for RViz and Foxglove, latched; in the frame
                 `world`, the foot that stands in its origin. On a way to an orbit the tube of
                 the orbit, too: where hip and swing foot may be in it
/tree/reference  from the tree controller, some times a second: the node that its reference is at
/tree/surface    lines of the poses on the transversal surface there, in the same frame

in    /tree/node, /tree/reference
out   /tree/selected, /tree/branch, /tree/markers, /tree/surface
"""

from dataclasses import dataclass

import numpy as np
from builtin_interfaces.msg import Duration
from geometry_msgs.msg import Point
from rclpy.node import Node
from std_msgs.msg import ColorRGBA, Int32, String
from std_srvs.srv import Trigger
from trajectory_msgs.msg import JointTrajectory, JointTrajectoryPoint
from visualization_msgs.msg import Marker, MarkerArray

from cg_control.trees.tree import Tree
from cg_control.trees.tree_files import TreeSelection, tree_path
from cg_control.trees.tube_view import surface_segments, tube_segments
from cg_control.trees.way_home import WayHome
from cg_description.paths import NOMINAL_MODEL, model_path
from cg_dynamics.model import Model
from cg_dynamics.rig import STANCES
from cg_interfaces.ros import LATCHED_QOS, SENSOR_QOS, DeclaredSettings, run
from cg_interfaces.settings import Settings, setting

FRAME = 'world'
WIDTH = 0.01  # m, of a line
# (red, green, blue) of each line; the legs as in the URDF.
COLOURS = {
    'hip': (0.2, 0.2, 0.2), 'inner_foot': (0.85, 0.45, 0.1), 'outer_foot': (0.1, 0.4, 0.75),
    'tube_hip': (0.2, 0.2, 0.2), 'tube_foot': (0.1, 0.6, 0.3), 'surface': (0.7, 0.1, 0.5),
}  # fmt: skip
THIN, CLEAR = 0.003, 0.5  # width in m and opacity of the lines of a tube and of a surface


@dataclass(frozen=True)
class TreeServerSettings(Settings):
    """Parameters of the tree server."""

    model_file: str = setting(
        '', 'model of the robot, a file or a name; empty for the nominal compass gait'
    )
    tree: str = setting(
        'compass_gait_mit', 'what is selected: a tree that comes along, or a file', live=True
    )


class TreeServerNode(Node):
    """Publishes /tree/selected."""

    def __init__(self, **kwargs):
        super().__init__('tree_server', **kwargs)
        self.declared = DeclaredSettings(self, TreeServerSettings)
        self.model = Model.load(self.declared.values.model_file or model_path(NOMINAL_MODEL))
        self.tree: Tree | None = None
        self.problem = 'nothing selected yet'
        self._way: WayHome | None = None
        self._followed: TreeServerSettings | None = None
        self.selected = self.create_publisher(String, '/tree/selected', LATCHED_QOS)
        self.branch = self.create_publisher(JointTrajectory, '/tree/branch', LATCHED_QOS)
        self.markers = self.create_publisher(MarkerArray, '/tree/markers', LATCHED_QOS)
        self.surface = self.create_publisher(MarkerArray, '/tree/surface', 10)
        self.create_subscription(Int32, '/tree/node', self.on_node, SENSOR_QOS)
        self.create_subscription(Int32, '/tree/reference', self.on_reference, SENSOR_QOS)
        self.create_service(Trigger, '~/load', self.on_load)
        self.poll()

    def poll(self) -> float:
        """Follow the selection."""
        if self._followed is not self.declared.values:
            self._select()
        return 0.1

    def _select(self) -> None:
        settings = self._followed = self.declared.values
        try:
            selection = TreeSelection.of(tree_path(settings.tree))
            tree = selection.load(self.model)
        except ValueError as error:
            self.problem = str(error)
            self.get_logger().error(self.problem)
            return
        self.tree, self.problem = tree, ''
        self.selected.publish(String(data=selection.text()))
        self.show(-1)
        self.get_logger().info(
            f'{settings.tree}: {len(tree.nodes)} nodes in {tree.nodes.branches} branches '
            f'to upright on the {" or ".join(tree.legs)} leg'
        )

    def on_load(self, request, response):
        """Take the selected file as it is now."""
        self._select()
        response.success, response.message = not self.problem, self.problem
        return response

    def on_node(self, message: Int32) -> None:
        """The controller went over to another node."""
        self.show(message.data)

    def on_reference(self, message: Int32) -> None:
        """The reference has moved on."""
        segments = np.zeros((0, 2, 2))
        if self.tree is not None and self._way is not None:
            segments = surface_segments(
                self.tree.nodes, self._way, message.data, self.model.values['leg_length']
            )
        self.surface.publish(segment_markers({'surface': segments}))

    def show(self, node: int) -> None:
        """Publish the way home from a node; an empty one where there is none."""
        self._way, length = None, self.model.values['leg_length']
        # Of the way before; namespaces that are not shown again would stay.
        tube = segment_markers({})
        if self.tree is not None and 0 <= node < len(self.tree.nodes):
            self._way = WayHome.along(self.tree.nodes, node)
            tube = segment_markers(tube_segments(self.tree.nodes, self._way, length))
        self.branch.publish(joint_trajectory(self._way))
        lines = marker_array(self._way, length)
        self.markers.publish(MarkerArray(markers=[*tube.markers, *lines.markers]))


def joint_trajectory(way: WayHome | None) -> JointTrajectory:
    """The way home: interfaces.md, "Trajectories"."""
    message = JointTrajectory(joint_names=list(STANCES))
    if way is None:
        return message
    message.header.frame_id = f'{STANCES[way.stance[0]]}_foot'
    for t, x, dx, u in zip(way.time, way.states, way.rates, way.torque, strict=True):
        seconds, rest = divmod(round(t * 1e9), 1_000_000_000)
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


def marker_array(way: WayHome | None, leg_length: float) -> MarkerArray:
    """Lines of hip and feet; none where there is no way.

    Args:
        way: The way home.
        leg_length: In m.
    """
    if way is None or len(way.nodes) < 2:
        return MarkerArray()
    lines = way.points(leg_length)
    return MarkerArray(markers=[
        _line(number, name, points) for number, (name, points) in enumerate(lines.items())
    ])  # fmt: skip


def segment_markers(segments: dict[str, np.ndarray]) -> MarkerArray:
    """What takes away everything of before, then segments (n, 2, 2) by name, if there are any."""
    gone = Marker(action=Marker.DELETEALL)
    gone.header.frame_id = FRAME
    return MarkerArray(markers=[gone] + [
        _line(number, name, ends.reshape(-1, 2), Marker.LINE_LIST, THIN, CLEAR)
        for number, (name, ends) in enumerate(segments.items()) if len(ends)
    ])  # fmt: skip


def _line(
    number: int, name: str, points: np.ndarray, kind: int = Marker.LINE_STRIP,
    width: float = WIDTH, opacity: float = 1.0,
) -> Marker:  # fmt: skip
    line = Marker(ns=name, id=number, type=kind, action=Marker.ADD)
    line.header.frame_id = FRAME
    line.pose.orientation.w = 1.0
    line.scale.x = width
    red, green, blue = COLOURS[name]
    line.color = ColorRGBA(r=red, g=green, b=blue, a=opacity)
    line.points = [Point(x=float(x), z=float(z)) for x, z in points]
    return line


def main(args: list[str] | None = None) -> int:
    """Entry point of `ros2 run cg_control tree_server_node`."""
    return run(TreeServerNode, TreeServerSettings, args)


if __name__ == '__main__':
    raise SystemExit(main())
