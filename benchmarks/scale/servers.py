"""The servers that are measured, and what they say of themselves."""

from __future__ import annotations

import contextlib
import os
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, fields
from typing import Any

import redis

from reem_async.server import EmbeddedServer
from reem_async.server.cluster import EmbeddedCluster

from .slots import shared_out

SETTINGS: dict[str, tuple[str, int, int]] = {
    "one": ("one server", 1, 0),
    "three": ("cluster of three primaries", 3, 0),
    "six": ("three primaries with a replica each", 3, 1),
}
"""By name: how it is called in tables, primaries, and replicas of each."""


@dataclass(frozen=True)
class Sample:
    """Counters of some servers, added up.

    Attributes:
        core: Seconds of CPU time of the main threads.
        process: Seconds of CPU time of all threads.
        bytes_in: Received from clients.
        bytes_out: Sent to clients.
        bytes_replica: Sent to replicas.
    """

    core: float = 0.0
    process: float = 0.0
    bytes_in: float = 0.0
    bytes_out: float = 0.0
    bytes_replica: float = 0.0

    def __add__(self, other: Sample) -> Sample:
        return self._with(other, 1.0)

    def __sub__(self, other: Sample) -> Sample:
        return self._with(other, -1.0)

    def times(self, factor: float) -> Sample:
        """Return all counters, multiplied."""
        return Sample(*(getattr(self, field.name) * factor for field in fields(self)))

    def _with(self, other: Sample, sign: float) -> Sample:
        return Sample(*(getattr(self, each.name) + sign * getattr(other, each.name) for each in fields(self)))


class Nodes:
    """Plain clients of some servers, to read their counters.

    Args:
        ports: Where they listen, on 127.0.0.1.
    """

    def __init__(self, ports: Sequence[int]) -> None:
        self._clients = [redis.Redis(port=port) for port in ports]

    def sample(self) -> Sample:
        """Return the counters as of now; asking costs what `asking` says."""
        return sum(self.samples(), Sample())

    def samples(self) -> list[Sample]:
        """Return the counters of each server."""
        return [_sample(client.info("cpu", "stats")) for client in self._clients]

    def asking(self) -> Sample:
        """Return what one `sample` adds to the counters, on average."""
        count = 10
        first = self.sample()
        for _ in range(count - 1):
            self.sample()
        return (self.sample() - first).times(1 / count)

    def total(self, section: str, name: str) -> int:
        """Return a number of INFO, added up."""
        return sum(int(client.info(section)[name]) for client in self._clients)

    def memory(self) -> int:
        """Return the bytes that data and connections take, without buffers, which come and go."""
        found = 0
        for client in self._clients:
            info = client.info("memory")
            found += info["used_memory"] - info["mem_clients_normal"] - info["mem_total_replication_buffers"]
        return found

    def usage(self, key: str) -> int:
        """Return MEMORY USAGE of a key, of all its parts, on the node that has it."""
        for client in self._clients:
            with contextlib.suppress(redis.ResponseError):  # MOVED
                return int(client.memory_usage(key, samples=0) or 0)
        raise KeyError(key)

    def close(self) -> None:
        """Close the connections."""
        for client in self._clients:
            client.close()


def _sample(info: dict[str, Any]) -> Sample:
    return Sample(
        info["used_cpu_user_main_thread"] + info["used_cpu_sys_main_thread"],
        info["used_cpu_user"] + info["used_cpu_sys"],
        # The server's totals contain what goes between it and its replicas.
        info["total_net_input_bytes"] - info["total_net_repl_input_bytes"],
        info["total_net_output_bytes"] - info["total_net_repl_output_bytes"],
        info["total_net_repl_output_bytes"],
    )


@dataclass(frozen=True)
class Running:
    """Servers that are up.

    Attributes:
        url: Where to connect.
        primaries: The servers that take writes.
        replicas: Those that stand by.
        version: Their program.
        count: How many primaries there are.
        ports: Where these listen.
    """

    url: str
    primaries: Nodes
    replicas: Nodes
    version: str
    count: int
    ports: Sequence[int]

    def address(self, slot: int) -> tuple[str, int]:
        """Return where the primary listens that has a slot."""
        return "127.0.0.1", self.ports[int(shared_out(self.count)[slot])]


@contextlib.contextmanager
def running(setting: str) -> Iterator[Running]:
    """Start the servers of a setting, and stop them at the end."""
    _, primaries, replicas = SETTINGS[setting]
    with contextlib.ExitStack() as stack:
        if setting == "one":
            server = stack.enter_context(EmbeddedServer())
            url = f"redis://127.0.0.1:{server.port}"  # TCP, as between machines
            ports = [server.port]
        else:
            cluster = stack.enter_context(EmbeddedCluster(primaries, replicas))
            url, ports = cluster.url, [node.port for node in cluster.nodes]
        first, rest = Nodes(ports[:primaries]), Nodes(ports[primaries:])
        stack.callback(first.close)
        stack.callback(rest.close)
        yield Running(url, first, rest, _version(ports[0]), primaries, ports[:primaries])


@contextlib.contextmanager
def all_running() -> Iterator[dict[str, Running]]:
    """Start the servers of all settings, and stop them at the end."""
    with contextlib.ExitStack() as stack:
        yield {setting: stack.enter_context(running(setting)) for setting in SETTINGS}


@contextlib.contextmanager
def on_one_core() -> Iterator[None]:
    """Have this process, and what it starts meanwhile, share one core, where the system can do that.

    The core does not sleep as long as anybody has work, so no operation pays for waking it: that is the
    busy server that matters, and the figures hardly vary. Else they double and halve from block to block.
    """
    if not hasattr(os, "sched_setaffinity"):
        yield
        return
    before = os.sched_getaffinity(0)
    os.sched_setaffinity(0, {max(before)})
    try:
        yield
    finally:
        os.sched_setaffinity(0, before)


def _version(port: int) -> str:
    with contextlib.closing(redis.Redis(port=port, decode_responses=True)) as client:
        info = client.info("server")
        modules = {module["name"]: module["ver"] for module in client.module_list()}
    number = info.get("valkey_version") or info["redis_version"]
    return f"{info.get('server_name', 'redis')} {number} (JSON module {modules.get('ReJSON', modules.get('json', 0))})"
