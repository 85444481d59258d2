"""A Ray cluster in a process of its own, which may be asked to kill its last node.

Ray forks the process that starts its nodes; that of the tests may be too large for it.
"""

from __future__ import annotations

import os
import subprocess
import sys
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

STORE_BYTES = 80 * 10**6


class ClusterProcess:
    """A running cluster; ``address`` is that of its head."""

    def __init__(self, process: subprocess.Popen[str]) -> None:
        self._process = process
        self.address = self._line()

    def kill_last_node(self) -> None:
        """Kill all processes of the last node, and wait until they are gone."""
        assert self._process.stdin is not None
        self._process.stdin.write("kill\n")
        self._process.stdin.flush()
        assert self._line() == "killed"

    def _line(self) -> str:
        assert self._process.stdout is not None
        line = self._process.stdout.readline().strip()
        assert line, "the cluster could not be started"
        return line


@contextmanager
def ray_cluster(*cpus: int) -> Iterator[ClusterProcess]:
    """A cluster with a node for each number of CPUs."""
    paths = [*sys.path, str(Path(__file__).parents[1])]
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join(path for path in paths if path)}
    command = [sys.executable, "-m", "support.ray_cluster", *map(str, cpus)]
    with subprocess.Popen(
        command, env=environment, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
    ) as process:
        yield ClusterProcess(process)
        assert process.stdin is not None
        process.stdin.close()  # which ends it


def main(cpus: Sequence[int]) -> None:
    """Start the nodes, print the address, and obey until the input ends."""
    from ray.cluster_utils import Cluster

    nodes: list[dict[str, Any]] = [{"num_cpus": count, "object_store_memory": STORE_BYTES} for count in cpus]
    cluster = Cluster(initialize_head=True, head_node_args={**nodes[0], "include_dashboard": False})
    others = [cluster.add_node(**node) for node in nodes[1:]]
    print(cluster.address, flush=True)
    for line in sys.stdin:
        if line.strip() == "kill":
            cluster.remove_node(others.pop(), allow_graceful=False)
            print("killed", flush=True)
    cluster.shutdown()


if __name__ == "__main__":
    main([int(text) for text in sys.argv[1:]])
