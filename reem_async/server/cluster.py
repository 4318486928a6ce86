"""A private, real cluster inside a program: for tests, and for trying how REEM behaves on one."""

from __future__ import annotations

import socket
import time
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from functools import partial

from ..errors import BadValue, ServerFailed
from .process import HOST, ServerProcess, ServerProgram, Startable, at_port, bindable, find_program, packed

SLOTS = 16384
JOIN_SECONDS = 30.0  # for all nodes to know of each other


class NodeProcess(ServerProcess):
    """One server of a cluster, up and not yet a member."""

    def __init__(self, program: ServerProgram, port: int, bus: int, node_timeout: float) -> None:
        self.bus = bus  # the port on which the nodes talk to each other
        self._node_timeout = node_timeout
        super().__init__(program, port=port, directory=None, password=None)
        self.id = self.say("CLUSTER", "MYID")  # what the cluster calls it

    def _config(self, program: ServerProgram, keep: bool, password: str | None) -> str:
        lines = [
            "cluster-enabled yes",
            f"cluster-port {self.bus}",
            f"cluster-node-timeout {round(self._node_timeout * 1000)}",
            # One dead primary must not stop the others.
            "cluster-require-full-coverage no",
            # A replica that is behind is better than none: there is nothing on disk to come back from.
            "cluster-replica-validity-factor 0",
            "repl-diskless-sync-delay 0",
        ]
        return super()._config(program, keep, password) + "\n".join(lines) + "\n"

    def say(self, *command: str) -> str:
        """Send one command and return the reply, which is a status, a number or a text.

        Raises:
            ServerFailed: It is gone, or refused.
        """
        with socket.socket(socket.AF_UNIX) as connection:
            connection.settimeout(5.0)
            try:
                connection.connect(self.socket_path)
                connection.sendall(packed(*command))
                with connection.makefile("rb") as replies:
                    first = replies.readline()
                    text = replies.read(int(first[1:])) if first.startswith(b"$") else first[1:].strip()
            except OSError as error:
                raise ServerFailed(f"the node on port {self.port} does not answer: {error}") from error
        if first[:1] not in (b"+", b":", b"$"):
            raise ServerFailed(f"the node on port {self.port} refused {' '.join(command)}: {text.decode()}")
        return text.decode()


class EmbeddedCluster(Startable):
    """A cluster of servers that belongs to this program and ends with it, however it ends.

        with EmbeddedCluster() as cluster:        # or: async with
            kvs = KeyValueStore(RedisInterface(cluster))

    Every node listens on 127.0.0.1 alone; what it holds is in memory and gone with it. The program that
    runs is the same as `EmbeddedServer`'s. It takes two to four seconds to start: a cluster waits for two
    until it takes writes.

    Attributes:
        nodes: The servers, primaries first, each with `port` and `pid`; empty before the start.
    """

    def __init__(self, primaries: int = 3, replicas: int = 1, node_timeout: float = 2.0, *, json: bool = True) -> None:
        """Prepare a cluster; `start` or a `with` block starts it.

        Args:
            primaries: How many nodes share the keys, from 3 (fewer cannot agree on a failover) to 100.
            replicas: How many nodes stand by for each of them, from 0 to 5.
            node_timeout: Seconds of silence after which the others think a node is gone; a failover takes
                about one second longer.
            json: False starts the nodes without loading a JSON module; one that is built into the program stays.

        Raises:
            BadValue: A number out of range.
        """
        if not 3 <= primaries <= 100:
            raise BadValue(f"primaries={primaries!r} is not in 3..100: fewer than three cannot agree on a failover")
        if not 0 <= replicas <= 5:
            raise BadValue(f"replicas={replicas!r} is not in 0..5")
        if not 0.2 <= node_timeout <= 60:
            raise BadValue(f"node_timeout={node_timeout!r} is not in 0.2..60 seconds")
        self._primaries = primaries
        self._replicas = replicas
        self._node_timeout = node_timeout
        self._json = json
        super().__init__()
        self.nodes: list[NodeProcess] = []

    def start(self) -> None:
        """Start all nodes and wait until the cluster takes writes; nothing if it runs already.

        Raises:
            ServerMissing: No server program was found; says what to install.
            ServerFailed: A node ended, or they did not find each other; nothing is left behind.
        """
        self._start()

    def _runs(self) -> bool:
        return bool(self.nodes)

    def _begin(self) -> Callable[[], object]:
        program = find_program(json=self._json)
        count = self._primaries * (1 + self._replicas)
        nodes: list[NodeProcess] = []
        try:
            with ThreadPoolExecutor(count, "reem-cluster") as threads:
                begun = [threads.submit(self._node, program) for _ in range(count)]
                failed = [each.exception() for each in begun]
                nodes += [each.result() for each, error in zip(begun, failed, strict=True) if error is None]
            for error in failed:
                if error is not None:
                    raise error
            self._join(nodes)
        except BaseException:
            stop_all(nodes)
            raise
        self.nodes = nodes
        return partial(stop_all, nodes)

    def _clear(self) -> None:
        super()._clear()
        self.nodes = []

    @property
    def url(self) -> str:
        """What to connect to: `redis+cluster://127.0.0.1:PORT,127.0.0.1:PORT,...`."""
        if not self.nodes:
            raise ServerFailed("the cluster is not started: use start() or a with block")
        return "redis+cluster://" + ",".join(f"{HOST}:{node.port}" for node in self.nodes)

    @property
    def json(self) -> bool:
        """Whether the nodes have JSON; without, REEM keeps documents as text there."""
        return all(node.json for node in self.nodes)

    def _node(self, program: ServerProgram) -> NodeProcess:
        return at_port(0, lambda port: NodeProcess(program, port, bindable(0), self._node_timeout))

    def _join(self, nodes: list[NodeProcess]) -> None:
        """Give out the slots, have the nodes meet, give the primaries their replicas, wait until all know."""
        primaries = nodes[: self._primaries]
        for place, node in enumerate(primaries):
            first, end = (round(SLOTS * n / len(primaries)) for n in (place, place + 1))
            node.say("CLUSTER", "ADDSLOTSRANGE", str(first), str(end - 1))
            node.say("CLUSTER", "SET-CONFIG-EPOCH", str(place + 1))
        for node in nodes[1:]:
            nodes[0].say("CLUSTER", "MEET", HOST, str(node.port), str(node.bus))
        deadline = time.monotonic() + JOIN_SECONDS
        for place, node in enumerate(nodes[self._primaries :]):
            primary = primaries[place % len(primaries)]
            _until(deadline, partial(_replicates, node, primary))
        _until(deadline, lambda: all(self._knows_all(node, nodes) for node in nodes))

    def _knows_all(self, node: NodeProcess, nodes: list[NodeProcess]) -> bool:
        """Return whether a node takes commands, knows all others, and sees the replicas in their places."""
        if "cluster_state:ok" not in node.say("CLUSTER", "INFO"):
            return False
        rows = [row.split() for row in node.say("CLUSTER", "NODES").splitlines()]
        kinds = [row[2].replace("myself,", "") for row in rows]
        standing_by = len(nodes) - self._primaries
        known = kinds.count("master") == self._primaries and kinds.count("slave") == standing_by
        synced = "role:slave" not in (text := node.say("INFO", "replication")) or "master_link_status:up" in text
        return known and synced

    def __repr__(self) -> str:
        state = f"{len(self.nodes)} nodes on {HOST}" if self.nodes else "not started"
        return f"<EmbeddedCluster {state}>"


def stop_all(nodes: list[NodeProcess]) -> None:
    """Stop the nodes, all at the same time; without threads, which cannot be had any more as the interpreter ends."""
    for node in nodes:
        node.order_to_end()
    for node in nodes:
        node.stop()


def _replicates(node: NodeProcess, primary: NodeProcess) -> bool:
    with suppress(ServerFailed):  # it has not heard of the primary yet
        node.say("CLUSTER", "REPLICATE", primary.id)
        return True
    return False


def _until(deadline: float, condition: Callable[[], bool]) -> None:
    while not condition():
        if time.monotonic() > deadline:
            raise ServerFailed(f"the nodes of the cluster did not find each other within {JOIN_SECONDS:g} s")
        time.sleep(0.01)
