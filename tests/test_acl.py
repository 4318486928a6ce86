"""The sample files in deploy/: users with only the rights REEM needs can do all of it, and nothing else."""

import contextlib
import re
import subprocess

import numpy as np
import pytest
import redis
import yaml
from conftest import FRONTS, PLAIN, ROOT, assert_same, eventually
from own_servers import connect, own_server

import reem
import reem_async
from reem_async.pubsub.monitor import Monitor
from reem_async.store.catalog import names

ALWAYS = {"auth", "hello", "quit", "reset"}
"""What a server lets everybody do."""


@pytest.fixture(scope="module")
def secrets(tmp_path_factory):
    folder = tmp_path_factory.mktemp("deploy") / "secrets"
    subprocess.run([ROOT / "deploy/prepare.sh", "-o", folder, "localhost", "127.0.0.1"], check=True, timeout=60)
    if PLAIN:  # as SECURITY.md says
        users = folder / "users.acl"
        users.write_text(re.sub(r" \+json\.\w+", "", users.read_text()))
    return folder


def password(secrets, user):
    return (secrets / f"{user}.password").read_text()


@pytest.fixture(scope="module")
def server(secrets):
    with own_server(f"aclfile {secrets / 'users.acl'}", wait=False) as process:
        yield process


@pytest.fixture(scope="module")
def admin(server, secrets):
    options = {"unix_socket_path": server.socket_path, "decode_responses": True}
    with redis.Redis(username="admin", password=password(secrets, "admin"), **options) as client:
        yield client


@pytest.fixture(scope="module")
def urls(server, secrets):
    users = ("admin", "robot", "watcher")
    return {user: server.url.replace("//", f"//{user}:{password(secrets, user)}@") for user in users}


@pytest.fixture(autouse=True)
def nothing_denied(admin):
    """Fails a test in which the server turned anything down; says what."""
    admin.execute_command("ACL", "LOG", "RESET")
    yield
    denied = [(row["reason"], row["object"], row["context"]) for row in admin.acl_log()]
    assert not denied, denied


@pytest.fixture
def stored(urls):
    with reem.RedisInterface(urls["robot"], namespace="robot1:") as interface:
        kvs = reem.KeyValueStore(interface)
        kvs["c"] = {"n": 1, "l": [1, 2], "image": np.arange(3), "b": b"x"}
        yield reem.PublishSpace(interface)
        del kvs["c"]


def test_the_robot_serves_and_calls(urls):
    """Services need two more channels and the directory of channels, and no other right."""
    with reem.RedisInterface(urls["robot"], namespace="robot1:") as interface:
        place = reem.KeyValueStore(interface)["policy"]["act"]
        with place.serve(lambda image: image + 1):
            assert int(place.call(image=np.zeros(30_000), timeout=5)[-1]) == 1


@pytest.mark.parametrize("name", list(FRONTS))
def test_a_watcher_reads_everything(urls, stored, name):
    with contextlib.closing(FRONTS[name](urls["watcher"], namespace="robot1:")) as front:
        for _ in range(2):
            assert_same(front.read(["c"]), {"n": 1, "l": [1, 2], "image": np.arange(3), "b": b"x"})
        assert (front.length(["c", "l"]), front.type(["c", "image"])) == (2, np.ndarray)
        assert front.read(["c", "l", -1]) == 2
        with pytest.raises(KeyError):
            front.read(["c", "absent"])
        assert front.read(["absent"]) is None
        assert (front.contains("absent"), front.contains("c")) == (False, True)


def test_a_watcher_follows_everything(urls, stored):
    interface = reem.RedisInterface(urls["watcher"], namespace="robot1:")
    with interface, reem.SilentSubscriber("c", interface) as mirror:
        stored["c"]["n"] = 2
        stored["c"]["image"] = np.zeros(100_000)
        eventually(lambda: mirror["n"].read() == 2 and mirror["image"].read().size == 100_000)


async def test_a_watcher_lists_and_monitors(urls, stored):
    async with reem_async.RedisInterface(urls["watcher"], namespace="robot1:") as interface:
        assert [name async for name in names(interface)] == ["c"]
        async with Monitor(interface) as heard:
            stored["c"]["n"] = 3
            assert (await anext(heard)).path == ("c", "n")


@pytest.mark.parametrize("name", list(FRONTS))
def test_a_watcher_changes_nothing(urls, stored, admin, name):
    """Each refusal names the command; nothing is written and nobody is told."""
    before = {key: admin.dump(key) for key in admin.scan_iter() if not key.endswith(":last")}
    for space in ("KeyValueStore", "PublishSpace"):
        with contextlib.closing(FRONTS[name](urls["watcher"], space, namespace="robot1:")) as front:
            for call in (
                lambda front=front: front.write(["c", "n"], 2),
                lambda front=front: front.write(["c"], np.zeros(3)),
                lambda front=front: front.increment(["c", "n"], 1),
                lambda front=front: front.append(["c", "l"], 1),
                lambda front=front: front.delete(["c"]),
            ):
                with pytest.raises(reem.NotAllowed, match=r"deploy/users\.acl"):
                    call()
    assert {key: admin.dump(key) for key in admin.scan_iter() if not key.endswith(":last")} == before
    admin.execute_command("ACL", "LOG", "RESET")


def every_command(admin):
    """All commands of the server and their subcommands, with as many words as they need at least."""
    for name, about in admin.command().items():
        below = about.get("subcommands") or []
        if not below:
            yield name, [name, *["robot1:x"] * (abs(about["arity"]) - 1)]
        for each in below:
            full, arity = each[0], each[1]
            full = full.decode() if isinstance(full, bytes) else full
            yield full, [*full.split("|"), *["robot1:x"] * (abs(arity) - 2)]


@pytest.mark.parametrize("user", ["robot", "watcher"])
def test_no_other_command_is_allowed(admin, user):
    """Asked of the server itself, command by command."""
    (line,) = re.findall(rf"^user {user} .*$", (ROOT / "deploy/users.acl").read_text(), re.M)
    granted = {name for name in re.findall(r" \+(\S+)", line) if not (PLAIN and name.startswith("json."))}
    allowed = set()
    tried = 0
    for name, words in every_command(admin):
        tried += 1
        answer = str(admin.execute_command("ACL", "DRYRUN", user, *words))
        if "has no permissions to run" not in answer:
            allowed.add(name)
    assert tried > 300
    assert allowed - ALWAYS == granted - ALWAYS


@pytest.mark.parametrize("user", ["robot", "watcher"])
def test_no_other_key_or_channel_is_allowed(urls, admin, user):
    """Those of another namespace, of none, and of one that begins alike."""
    with admin.pipeline(transaction=False) as pipe:
        for name in ("foo", "robot2:foo", "robot11:foo", "xrobot1:foo", "{robot2:foo}.image"):
            pipe.set(name, "1")
        pipe.execute()
    with redis.Redis.from_url(urls[user], decode_responses=True) as client:
        for name in ("foo", "robot2:foo", "robot11:foo", "xrobot1:foo", "{robot2:foo}.image", "{xrobot1:foo}"):
            with pytest.raises(redis.exceptions.NoPermissionError):
                client.get(name)
        for channel in ("{robot2:foo}:notices", "robot1:foo", "{robot1:foo}:other", "__redis__:invalidate"):
            with pytest.raises(redis.exceptions.NoPermissionError):
                client.execute_command("SUBSCRIBE", channel)
            with pytest.raises(redis.exceptions.NoPermissionError):
                client.publish(channel, "x")
    for namespace in ("", "robot2:"):
        with reem.RedisInterface(urls[user], namespace=namespace) as interface:
            with pytest.raises(reem.NotAllowed, match="foo"):
                reem.KeyValueStore(interface)["foo"].read()
            with pytest.raises(reem.NotAllowed, match="foo"):
                reem.SilentSubscriber("foo", interface).listen()
    admin.flushall()
    admin.execute_command("ACL", "LOG", "RESET")


def test_nobody_gets_in_without_a_password(server, secrets, admin):
    """Not by default, and not by the sample as it is: it has no passwords at all."""
    others = {"username": "robot", "password": password(secrets, "watcher")}
    for options in ({}, {"username": "robot"}, {"password": "x"}, others):
        with pytest.raises(reem.LoginRefused):
            connect("blocking", server.url, **options)
    with own_server(f"aclfile {ROOT / 'deploy/users.acl'}", wait=False) as untouched:
        for options in ({}, *({"username": user, "password": ""} for user in ("default", "admin", "robot", "watcher"))):
            with pytest.raises(reem.LoginRefused):
                connect("blocking", untouched.url, **options)
    assert (secrets.stat().st_mode & 0o777, (secrets / "ca.key").stat().st_mode & 0o777) == (0o700, 0o600)
    admin.execute_command("ACL", "LOG", "RESET")


def test_preparing_twice_or_wrongly_changes_nothing(secrets):
    """The files of a running robot are not replaced by accident."""
    before = {file.name: file.read_bytes() for file in secrets.iterdir()}
    for words in (["-o", secrets, "localhost"], ["-o", secrets], ["-n", "a b", "-o", secrets / "new", "localhost"]):
        done = subprocess.run([ROOT / "deploy/prepare.sh", *words], capture_output=True, check=False, timeout=60)
        assert done.returncode != 0
        assert done.stderr
    assert {file.name: file.read_bytes() for file in secrets.iterdir()} == before


@pytest.mark.parametrize("namespace", ["", "arm_2."])
def test_another_namespace(tmp_path, namespace):
    """-n restricts to it; the empty one opens the server."""
    folder = tmp_path / "s"
    subprocess.run([ROOT / "deploy/prepare.sh", "-n", namespace, "-o", folder, "localhost"], check=True, timeout=60)
    with own_server(f"aclfile {folder / 'users.acl'}", wait=False) as process:
        options = {"username": "robot", "password": password(folder, "robot")}
        with reem.RedisInterface(process.url, namespace=namespace, **options) as interface:
            with reem.SilentSubscriber("foo", interface) as mirror:
                reem.PublishSpace(interface)["foo"] = np.arange(3)
                eventually(lambda: mirror.value() is not None)
            assert reem.KeyValueStore(interface)["foo"].read().tolist() == [0, 1, 2]
        with reem.RedisInterface(process.url, namespace="other:", **options) as interface:
            if namespace:
                with pytest.raises(reem.NotAllowed):
                    reem.KeyValueStore(interface)["foo"].read()


def test_a_server_takes_the_sample_configuration(secrets):
    """As it is, but for the folder and, where the server was built without TLS, the lines on that."""
    text = (ROOT / "deploy/secured.conf").read_text().replace("/etc/reem", str(secrets))
    plain = [line for line in text.splitlines() if line and not line.startswith(("#", "tls-", "port ", "bind "))]
    with own_server(*plain, wait=False) as process:
        login = {"username": "admin", "password": password(secrets, "admin")}
        with redis.Redis(unix_socket_path=process.socket_path, decode_responses=True, **login) as client:
            assert client.config_get("maxmemory-policy")["maxmemory-policy"] == "noeviction"
            assert client.config_get("maxmemory")["maxmemory"] == str(1 << 30)
            assert "pubsub 33554432 8388608 60" in client.config_get("client-output-buffer-limit").popitem()[1]
        options = {"username": "robot", "password": password(secrets, "robot")}
        with reem.RedisInterface(process.url, namespace="robot1:", **options) as interface:
            reem.KeyValueStore(interface)["foo"] = np.arange(3)


def test_compose_starts_the_server_with_these_files():
    """What it mounts is there or made by prepare.sh; only loopback unless somebody says otherwise."""
    composed = yaml.safe_load((ROOT / "compose.yaml").read_text())
    service = composed["services"]["secured"]
    assert service["profiles"] == ["secured"]
    assert service["command"] == ["redis-server", "/etc/reem/secured.conf"]
    assert service["ports"] == ["${REEM_BIND:-127.0.0.1}:${REEM_PORT:-6379}:6379"]
    mounted = dict(volume.split(":")[:2] for volume in service["volumes"])
    assert mounted.pop("secured") == "/data"
    assert "secured" in composed["volumes"]
    wanted = set(re.findall(r"/etc/reem/\S+", (ROOT / "deploy/secured.conf").read_text().partition("port 0")[2]))
    assert set(mounted.values()) == wanted | {"/etc/reem/secured.conf"}
    for source in mounted:
        assert (ROOT / source).is_file() or source.startswith("./deploy/secrets/")
    check = " ".join(service["healthcheck"]["test"])
    assert set(re.findall(r"/etc/reem/\S+", check)) <= wanted


def test_everything_security_md_says_to_type_works(secrets, server, admin, urls):
    """Its lines for the administrator, and its program, with the files of this test in place of the robot's."""
    text = (ROOT / "SECURITY.md").read_text()
    (program,) = re.findall(r"```python\n(.*?)```", text, re.S)
    program = program.replace("deploy/secrets", str(secrets)).replace("rediss://robot.local:6379", server.url)
    program = re.sub(r"\n *ssl_\w+=.*", "", program)  # TLS itself: tests/test_secured.py
    exec(compile(program, "SECURITY.md", "exec"), {})
    shell = "\n".join(re.findall(r"```sh\n(.*?)```", text, re.S))
    for command in re.findall(r"^redis-cli \$R (.+)$", shell, re.M):
        words = [word.strip('"') for word in command.replace("$NEW", "0123456789").split()]
        assert not isinstance(admin.execute_command(*words), Exception), command
    assert len(re.findall(r"^redis-cli", shell, re.M)) >= 3
    for script, options in re.findall(r"^(deploy/\S+)(.*)$", shell, re.M):
        assert (ROOT / script).stat().st_mode & 0o100
        assert re.fullmatch(r"( -n \S+)?( \S+)+", options), options
    for command in re.findall(r"^openssl .*$", shell, re.M):
        subprocess.run(command.replace("deploy/secrets", str(secrets)), shell=True, check=True, timeout=20)
    admin.execute_command("ACL", "LOG", "RESET")
