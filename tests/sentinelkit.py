"""A primary, a replica and three sentinels on loopback, for tests."""

import contextlib
import subprocess

import redis
from conftest import eventually
from own_servers import free_port

from reem_async.server import EmbeddedServer
from reem_async.server.process import find_program

SERVICE = "mymaster"


class Watched:
    """Two servers and who watches them.

    Attributes:
        url: What to connect to.
        servers: The primary of the beginning and its replica.
    """

    def __init__(self, directory, stack, *, json=True):
        self.servers = [stack.enter_context(EmbeddedServer(json=json)) for _ in range(2)]
        self.raw = [
            stack.enter_context(redis.Redis(port=server.port, decode_responses=True)) for server in self.servers
        ]
        for raw in self.raw:
            raw.config_set("repl-diskless-sync-delay", 0)
        self.raw[1].replicaof("127.0.0.1", self.servers[0].port)
        eventually(lambda: self.raw[1].info("replication").get("master_link_status") == "up")
        self.ports = []
        self.sentinels = []
        for number in range(3):
            port = free_port()
            file = directory / f"sentinel{number}.conf"
            file.write_text(
                f"port {port}\nbind 127.0.0.1\ndir {directory}\n"
                f"sentinel monitor {SERVICE} 127.0.0.1 {self.servers[0].port} 2\n"
                f"sentinel down-after-milliseconds {SERVICE} 500\n"
                f"sentinel failover-timeout {SERVICE} 2000\n"
            )
            process = subprocess.Popen(
                [find_program().path, str(file), "--sentinel"], stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL
            )
            stack.callback(_ended, process)
            self.ports.append(port)
            self.sentinels.append(stack.enter_context(redis.Redis(port=port, decode_responses=True)))
        eventually(self._know_each_other)
        self.url = "redis+sentinel://" + ",".join(f"127.0.0.1:{port}" for port in self.ports) + f"/{SERVICE}"

    def _know_each_other(self):
        with contextlib.suppress(redis.exceptions.RedisError):
            return all(
                (row := sentinel.sentinel_master(SERVICE))["num-other-sentinels"] == 2 and row["num-slaves"] == 1
                for sentinel in self.sentinels
            )
        return False

    def primary(self):
        return self.sentinels[0].sentinel_get_master_addr_by_name(SERVICE)[1]

    def now(self):
        return self._raw(master=True)

    def standby(self):
        return self._raw(master=False)

    def _raw(self, master):
        for raw in self.raw:
            with contextlib.suppress(redis.exceptions.ConnectionError):
                if (raw.role()[0] == "master") is master:
                    return raw
        raise AssertionError("there is none")

    def fail_over(self):
        """Have a sentinel begin a failover; whether it does, since the one before may not be over."""
        with contextlib.suppress(redis.exceptions.ResponseError):
            return self.sentinels[0].execute_command("SENTINEL", "FAILOVER", SERVICE)
        return False

    def settle(self):
        """Wait until the sentinels agree with the servers about which is the primary, and the replica follows."""
        eventually(self._agreed)

    def _agreed(self):
        with contextlib.suppress(AssertionError, redis.exceptions.RedisError):
            port = self.now().connection_pool.connection_kwargs["port"]
            named = {each.sentinel_get_master_addr_by_name(SERVICE)[1] for each in self.sentinels}
            return named == {port} and self.standby().info("replication")["master_link_status"] == "up"
        return False

    def pid(self, port):
        return next(server.pid for server in self.servers if server.port == port)


def _ended(process):
    process.kill()
    process.wait()
