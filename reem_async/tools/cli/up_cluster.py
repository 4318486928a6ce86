"""`reem up --cluster`: a private cluster in the foreground."""

from __future__ import annotations

from contextlib import suppress

from rich.console import Console
from rich.text import Text

from reem_async.errors import ServerFailed, ServerMissing
from reem_async.server.cluster import EmbeddedCluster
from reem_async.tools.cli.foreground import LOOK_SECONDS, Stop, fail, print_rows
from reem_async.tools.cli.wording import for_users


def up_cluster(stop: Stop, *, plain: bool) -> None:
    """Keep a cluster up until told to stop; a node that ends is told of, and the others go on."""
    console = Console()
    try:
        with EmbeddedCluster(json=not plain) as cluster:
            console.print(Text("REEM's cluster is up.", style="bold green"))
            print_rows(console, _rows(cluster))
            left = list(cluster.nodes)
            while not stop.wait(LOOK_SECONDS):
                for node in [node for node in left if node.ended()]:
                    left.remove(node)
                    console.print(f"The node on port {node.port} has ended; the others go on.")
    except (ServerFailed, ServerMissing) as error:
        fail(for_users(error))
    with suppress(OSError):  # the terminal may have closed
        console.print("Stopped. The data is gone.")


def _rows(cluster: EmbeddedCluster) -> list[tuple[str, str]]:
    """What there is to know of it."""
    connect = f'KeyValueStore(RedisInterface("{cluster.url}"))'
    half = len(cluster.nodes) // 2
    nodes = [f"port {node.port}, process {node.pid}" for node in cluster.nodes]
    return [
        ("address", cluster.url),
        *zip(["primaries", *[""] * (half - 1)], nodes[:half], strict=True),
        *zip(["replicas", *[""] * (half - 1)], nodes[half:], strict=True),
        ("documents", "by their JSON module" if cluster.json else "as text: the nodes have no JSON module"),
        ("data", "in memory, gone when the cluster stops"),
        ("blocking", f"from reem import KeyValueStore, RedisInterface; kvs = {connect}"),
        ("asyncio", f"from reem_async import KeyValueStore, RedisInterface; kvs = {connect}"),
        ("to stop", "Ctrl-C"),
    ]
