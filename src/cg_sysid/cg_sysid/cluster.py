"""Fits on other machines: an executor whose workers are those of a dask.distributed cluster.

    with Cluster('tcp://192.168.0.7:8786') as cluster:
        answer = diagnose(model, records, executor=cluster)

What is sent is what local processes get (parallel.py), the records once for each content.
"""

import functools

import cg_description
import cg_dynamics
import cg_sysid
from cg_dynamics import cluster
from cg_dynamics.cluster import ClusterError
from cg_sysid.provenance import software

__all__ = ['Cluster', 'ClusterError', 'software_here']


class Cluster(cluster.Cluster):
    """The workers behind a scheduler, for fits.

    Args:
        address: Of the scheduler: tcp://HOST:PORT, or tls://HOST:PORT.
        patience: Time in s without any worker after which work is given up.

    Raises:
        ClusterError: as cg_dynamics.cluster says.
    """

    def __init__(self, address: str, patience: float = cluster.PATIENCE_S):
        super().__init__(address, software_here, patience)


@functools.cache
def software_here() -> dict[str, str]:
    """What decides an answer: versions of Python and packages, and our own source, hashed."""
    source = cluster.source_hash(cg_description, cg_dynamics, cg_sysid)
    return {**software(), **cluster.tools_here(), 'source of cg_sysid and what it imports': source}
