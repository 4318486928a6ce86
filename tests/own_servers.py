"""Private servers with settings of their own, and peers that only pretend to be servers."""

import asyncio
import contextlib
import inspect
import random
import socket
import threading
import time

import numpy as np
import redis
from conftest import PATIENCE

import reem
import reem_async
from reem_async.server.process import HOST, PortTaken, ServerProcess, ServerProgram, find_program


class Configured(ServerProcess):
    """A server with lines of configuration of one's own; without `wait`, it may still be loading."""

    def __init__(self, program, lines, *, port, directory=None, wait=True):
        self._lines = lines
        self._wait = wait
        super().__init__(program, port=port, directory=directory, password=None)

    def _config(self, *args):
        return super()._config(*args) + "".join(f"{line.format(port=self.port)}\n" for line in self._lines)

    def _wait_until_ready(self, program, offset, password):
        if self._wait:
            super()._wait_until_ready(program, offset, password)
            return
        deadline = time.monotonic() + PATIENCE
        while not self.ask("PING"):
            late = self.ended() or time.monotonic() > deadline
            assert not late, f"the server does not even answer{self._last_words(offset)}"
            time.sleep(0.002)

    @property
    def url(self):
        return f"redis://{HOST}:{self.port}"

    @contextlib.contextmanager
    def admin(self):
        """A plain client with all rights, over the unix socket."""
        with redis.Redis(unix_socket_path=self.socket_path, decode_responses=True) as client:
            yield client


def program(json=True):
    found = find_program()
    return found if json else ServerProgram(found.path)


def free_port():
    """A port that nobody has, and whose number plus 10000 is a port too (cluster nodes take both).

    It is below those that the kernel gives to clients: one of them could be given it while its server is down.
    """
    while True:
        port = random.randrange(20_000, 32_000)
        with socket.socket() as one, socket.socket() as other, contextlib.suppress(OSError):
            one.bind((HOST, port))
            other.bind((HOST, port + 10000))
            return port


def other_addresses():
    """Addresses of this machine besides loopback; nothing is sent to find them out."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        try:
            probe.connect(("192.0.2.1", 9))
        except OSError:
            return []
        address = probe.getsockname()[0]
    return [] if address.startswith("127.") else [address]


@contextlib.contextmanager
def own_server(*lines, json=True, directory=None, wait=True):
    chosen = program(json)
    while True:
        with contextlib.suppress(PortTaken):
            process = Configured(chosen, lines, port=free_port(), directory=directory, wait=wait)
            break
    try:
        yield process
    finally:
        process.stop()


HELLO = (
    b"%3\r\n$6\r\nserver\r\n$5\r\nredis\r\n$5\r\nproto\r\n:3\r\n"
    b"$7\r\nmodules\r\n*1\r\n%1\r\n$4\r\nname\r\n$6\r\nReJSON\r\n"
)


@contextlib.contextmanager
def liar(answer, greets=True):
    """A peer that greets like a server, then answers each command with what `answer(words)` gives; its address.

    None closes the connection.
    """
    listener = socket.create_server((HOST, 0))
    open_sockets = []
    ended = threading.Event()

    def serve(connection):
        with contextlib.suppress(OSError, ValueError), connection, connection.makefile("rb") as received:
            while not ended.is_set():
                words = _command(received)
                if words is None:
                    return
                name = words[0].upper()
                if greets and name in (b"HELLO", b"CLIENT", b"SELECT", b"AUTH"):
                    reply = HELLO if name == b"HELLO" else b"+OK\r\n"
                else:
                    reply = answer(words)
                if reply is None:
                    return
                connection.sendall(reply)

    def accept():
        with contextlib.suppress(OSError):
            while True:
                connection, _ = listener.accept()
                open_sockets.append(connection)
                threads.append(threading.Thread(target=serve, args=(connection,), daemon=True))
                threads[-1].start()

    threads = [threading.Thread(target=accept, daemon=True)]
    threads[0].start()
    try:
        yield f"redis://{HOST}:{listener.getsockname()[1]}"
    finally:
        ended.set()
        with contextlib.suppress(OSError):
            listener.shutdown(socket.SHUT_RDWR)
        listener.close()
        threads[0].join(PATIENCE)
        for connection in open_sockets:
            with contextlib.suppress(OSError):
                connection.shutdown(socket.SHUT_RDWR)
            connection.close()
        for thread in threads:
            thread.join(PATIENCE)
            assert not thread.is_alive()


def _command(received):
    line = received.readline()
    if not line.startswith(b"*"):
        return None
    words = []
    for _ in range(int(line[1:])):
        size = int(received.readline()[1:])
        words.append(received.read(size + 2)[:-2])
    return words


# --- either front, not even initialized ----------------------------------------------------------


class Caller:
    """An interface of either front that nobody has initialized, and its calls, made to completion."""

    def __init__(self, name, url, **options):
        module = reem if name == "blocking" else reem_async
        self.interface = module.RedisInterface(url, **options)
        self._runner = asyncio.Runner()
        kvs, space = module.KeyValueStore(self.interface), module.PublishSpace(self.interface)
        self.calls = [
            self.interface.initialize,
            kvs["foo"].read,
            lambda: kvs["foo"].write(1),
            lambda: kvs["foo"].write(np.zeros(3)),
            lambda: space["foo"].write(1),
            lambda: space["foo"].write(np.zeros(3)),
            module.SilentSubscriber("foo", self.interface).listen,
        ]

    def __call__(self, function):
        async def run():
            done = function()
            return await done if inspect.isawaitable(done) else done

        return self._runner.run(run())

    def close(self):
        self(self.interface.close)
        self._runner.close()


def caller(*args, **options):
    return contextlib.closing(Caller(*args, **options))


def connect(name, url, **options):
    """Initialize an interface, whatever comes of it, and close it."""
    with caller(name, url, **options) as made:
        made(made.interface.initialize)
