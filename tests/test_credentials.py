"""Passwords are never shown, and whoever can be overheard is told so; in both fronts."""

import contextlib
import logging
import ssl
import traceback
import warnings

import pytest
import redis
from conftest import FRONTS
from own_servers import connect, liar, own_server
from redis.credentials import CredentialProvider

import reem
import reem_async
from reem_async.server.process import HOST
from reem_async.transport import options as options_module

both = pytest.mark.parametrize("name", list(FRONTS))


PASSWORD = "p%41s@ word:%zz/+#"
ENCODED = "p%2541s%40%20word%3A%25zz%2F%2B%23"
WAYS = {
    "in the URL": lambda port: (f"redis://robot:{ENCODED}@{HOST}:{port}", {}),
    "as an option": lambda port: (f"redis://{HOST}:{port}", {"username": "robot", "password": PASSWORD}),
    "of a provider": lambda port: (f"redis://{HOST}:{port}", {"credential_provider": Provider()}),
}


class Provider(CredentialProvider):
    """Hands out what a file or a vault would."""

    def get_credentials(self):
        return "robot", PASSWORD


def shows(text):
    """Whether a text gives the password away, encoded or not."""
    return any(part in text for part in (PASSWORD, ENCODED, "s@ word", "2541s"))


def everything_shown(error, *things):
    """All that an error and things would show in a log or on a terminal."""
    lines = traceback.format_exception(error)
    linked = [error, error.__cause__, error.__context__]
    return "".join([line for line in lines if not line.lstrip().startswith("File")]) + "".join(
        f"{thing}{thing!r}{getattr(thing, 'args', '')}" for thing in (*linked, *things)
    )


@both
@pytest.mark.parametrize("way", list(WAYS))
def test_a_password_is_never_shown(name, way, caplog):
    """Not by what works, not by any error of the server, and not by one of a peer that repeats what it was sent."""
    caplog.set_level(logging.DEBUG)
    module = reem if name == "blocking" else reem_async
    with own_server() as process, process.admin() as admin:
        admin.execute_command("ACL", "SETUSER", "robot", "on", f">{PASSWORD}", "~*", "&*", "+@all")
        url, options = WAYS[way](process.port)
        with contextlib.closing(FRONTS[name](url, **options)) as front:
            front.write(["foo"], 1)
            core = getattr(front.interface, "_direct", front.interface)
            session = core.session
            shown = [front.interface, core, session, session.options, session.transport, front.kvs, front.at(["foo"])]
            assert not shows("".join(f"{thing!r}{thing}" for thing in (*shown, front.interface.hostname)))
            admin.execute_command("ACL", "SETUSER", "robot", "resetpass", ">another")
            admin.execute_command("CLIENT", "KILL", "TYPE", "normal", "SKIPME", "yes")
            seen = []
            for _ in range(3):  # the connection is gone, then the password wrong
                with contextlib.suppress(redis.exceptions.RedisError):
                    try:
                        front.read(["foo"])
                    except Exception as error:
                        seen.append(error)
                        raise
        assert any(isinstance(error, reem.LoginRefused) for error in seen)
        assert not any(shows(everything_shown(error)) for error in seen)
    login = f"'AUTH' 'robot' '{PASSWORD}'"
    quoting = f"-ERR unknown command 'HELLO', with args beginning with: {login}\r\n".encode()

    def echo(words):
        return b"-ERR unknown command, said: " + b" ".join(words).replace(b"\r\n", b"") + b"\r\n"

    for answer in (lambda words: quoting, *([echo] if way != "of a provider" else [])):
        with liar(answer, greets=False) as address:
            url, options = WAYS[way](address.rpartition(":")[2])
            with pytest.raises(reem.NotConnected) as caught:
                connect(name, url, **options)
            text = str(caught.value)
            assert not shows(text), text
    url, options = WAYS[way](1)
    with pytest.raises(module.NotConnected) as caught:
        connect(name, url, **options)
    assert not shows(everything_shown(caught.value))
    assert not shows(caplog.text)


def test_a_password_in_the_place_of_a_host_is_refused_unseen():
    """Without redis:// it would be taken for a host name, and shown in every error."""
    for module in (reem, reem_async):
        with pytest.raises(reem.BadValue, match="URL") as caught:
            module.RedisInterface(f"robot:{PASSWORD}@robot.example")
        assert not shows(everything_shown(caught.value))


@pytest.fixture
def unwarned(monkeypatch):
    """As if nothing had been warned of yet."""
    monkeypatch.setattr(options_module, "_said", set())


HERE = ["localhost", "127.0.0.1", "127.1.2.3", "::1", "::ffff:127.0.0.1", "redis://[::1]:6379", "robot.localhost"]
ELSEWHERE = ["192.168.1.5", "robot.example", "redis://:secret@10.0.0.1:7000/2", "redis://[fe80::1]", "::ffff:10.0.0.1"]


@pytest.mark.parametrize("module", [reem, reem_async])
@pytest.mark.parametrize("host", ELSEWHERE)
def test_an_open_connection_to_another_machine_warns_once(unwarned, module, host):
    """With and without a password; nothing is looked up or connected to, and the warning names the caller's line."""
    with pytest.warns(reem.InsecureConnection, match=r"not encrypted.*rediss://") as caught:
        module.RedisInterface(host)
    assert len(caught) == 1
    assert caught[0].filename == __file__
    assert "secret" not in str(caught[0].message)
    module.RedisInterface(host)  # warnings are errors here
    (reem if module is reem_async else reem_async).RedisInterface(host)
    with pytest.warns(reem.InsecureConnection):
        module.RedisInterface("another.example")


@pytest.mark.parametrize("module", [reem, reem_async])
def test_what_nobody_else_can_hear_does_not_warn(unwarned, module):
    """This machine by any name, a unix socket, TLS."""
    for host in [*HERE, "unix:///tmp/reem.sock", "rediss://robot.example"]:
        module.RedisInterface(host)
    module.RedisInterface("robot.example", ssl=True)
    module.RedisInterface(unix_socket_path="/tmp/reem.sock")


def test_tls_without_checking_who_answers_warns(unwarned):
    for options in ({"ssl_cert_reqs": "none"}, {"ssl_cert_reqs": ssl.CERT_NONE}):
        options_module._said.clear()
        with pytest.warns(reem.InsecureConnection, match="who the server is"):
            reem.RedisInterface("rediss://robot.example", **options)
    reem.RedisInterface("rediss://localhost", ssl_cert_reqs="none")


def test_the_warning_can_be_silenced(unwarned):
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", category=reem.InsecureConnection)
        reem.RedisInterface("robot.example")


@pytest.mark.filterwarnings("ignore::reem.InsecureConnection")
@pytest.mark.parametrize(
    ("given", "shown"),
    [
        ("redis://u:secret@localhost:7/3", "redis://localhost:7/3"),
        ("rediss://u:secret@robot:7", "rediss://robot:7"),
        ("unix://u:secret@/tmp/x.sock?db=2", "unix:///tmp/x.sock?db=2"),
        ("redis+cluster://u:secret@a:1,b:2", "redis+cluster://a:1,b:2"),
        ("rediss+sentinel://u:secret@a:1,b:2/main/3", "rediss+sentinel://a:1,b:2/main/3"),
    ],
)
def test_the_address_that_is_shown_to_be_copied_leads_there_without_the_password(given, shown):
    options = reem.RedisInterface(given)._core.session.options
    assert options.url == shown
    again = reem.RedisInterface(shown)._core.session.options
    assert (again.url, again.address, again.database) == (shown, options.address, options.database)
