"""Planning on other machines: an executor whose workers are those of a dask.distributed cluster.

    with Cluster('tcp://192.168.0.7:8786') as cluster:
        extension = Extension(model, executor=cluster)

A state goes out with the robot and the piece of the tree on which its motion may end.
"""

import functools
import platform
from importlib import metadata

import cg_control
import cg_description
import cg_dynamics
from cg_dynamics import cluster
from cg_dynamics.watched_processes import LIMIT

PACKAGES = ('numpy', 'scipy', 'casadi')


class Cluster(cluster.Cluster):
    """The workers behind a scheduler, for planning.

    Args:
        address: Of the scheduler: tcp://HOST:PORT, or tls://HOST:PORT.
        limit: Time in s of wall after which planning for a state ends its worker. The state goes
            to others, until dask allows no more failures; then it is lost.

    Raises:
        ClusterError: as cg_dynamics.cluster says.
    """

    def __init__(self, address: str, limit: float = LIMIT):
        super().__init__(address, software_here, limit=limit)


@functools.cache
def software_here() -> dict[str, str]:
    """What decides an answer: versions of Python and packages, and our own source, hashed."""
    source = cluster.source_hash(cg_description, cg_dynamics, cg_control)
    return {
        'python': platform.python_version(),
        **{package: metadata.version(package) for package in PACKAGES},
        **cluster.tools_here(),
        'source of cg_control and what it imports': source,
    }
