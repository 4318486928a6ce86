"""One private server for all contenders."""

import contextlib
import dataclasses
import socket
from collections.abc import Iterator

import redis

from reem_async.server import EmbeddedServer

USUAL_PORT = 6379  # the only one the original can be told to use


@dataclasses.dataclass(frozen=True)
class Server:
    """Where the server listens."""

    port: int
    host: str = "127.0.0.1"

    @property
    def url(self) -> str:
        """Over TCP, as every comparison is made."""
        return f"redis://{self.host}:{self.port}"

    def pid(self) -> int:
        """Its process."""
        with redis.Redis(host=self.host, port=self.port) as client:
            return int(client.info("server")["process_id"])

    def seconds(self) -> float:
        """CPU time that it has used, its own and the kernel's for it."""
        with redis.Redis(host=self.host, port=self.port) as client:
            used = client.info("cpu")
        return float(used["used_cpu_user"]) + float(used["used_cpu_sys"])

    def empty(self) -> None:
        """Forget all data: this server is the benchmark's own."""
        with redis.Redis(host=self.host, port=self.port) as client:
            client.flushall()

    def version(self) -> str:
        """Server and JSON module, as they name themselves."""
        with redis.Redis(host=self.host, port=self.port, decode_responses=True) as client:
            info = client.info("server")
            modules = client.module_list()
        name = info.get("server_name", "redis")
        number = info.get("valkey_version") or info["redis_version"]
        numbers = {_text(module["name"]): module["ver"] for module in modules}
        json_version = numbers.get("ReJSON", numbers.get("json", 0))
        return f"{name} {number} (JSON module {json_version})"


def socket_of(url: str) -> str:
    """The path of a server's Unix socket."""
    with redis.Redis.from_url(url, decode_responses=True) as client:
        return str(client.config_get("unixsocket")["unixsocket"])


def _text(name: bytes | str) -> str:
    return name.decode() if isinstance(name, bytes) else name


def free_port(wanted: int = 0) -> int:
    """The wanted port if nobody listens there, else any free one."""
    for port in (wanted, 0):
        with socket.socket() as probe, contextlib.suppress(OSError):
            probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
            probe.bind(("127.0.0.1", port))
            return int(probe.getsockname()[1])
    raise OSError("no free port")


@contextlib.contextmanager
def private_server() -> Iterator[Server]:
    """Start a server on port 6379 if that is free, else on another one, and stop it at the end."""
    port = free_port(USUAL_PORT)
    with EmbeddedServer(port=port):
        yield Server(port)
