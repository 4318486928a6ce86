"""TLS with certificates on one side or both, and what is refused; in both fronts."""

import asyncio
import contextlib
import datetime
import socket
import ssl
import time

import numpy as np
import pytest
import redis
import trustme
from chaos.proxy import Proxy
from conftest import FRONTS, PATIENCE, PLAIN, assert_same, eventually
from own_servers import connect, own_server

import reem
import reem_async
from reem_async.server.process import HOST

both = pytest.mark.parametrize("name", list(FRONTS))
LARGE = 1 << 20
"""Items of a float64 array of 8 MB."""


# --- a server behind TLS ---------------------------------------------------------------------------


class Certificates:
    """An authority of one's own and what it has issued, as files."""

    def __init__(self, folder):
        self._folder = folder
        self._authority = trustme.CA()
        self.ca = str(folder / "ca.crt")
        self._authority.cert_pem.write_to_path(self.ca)
        self.server = self.issue("server", "localhost", HOST)
        self.robot = self.issue("robot", "robot@reem.example")
        self.elsewhere = self.issue("elsewhere", "elsewhere.example")
        yesterday = datetime.datetime.now(datetime.UTC) - datetime.timedelta(days=1)
        self.expired = self.issue("expired", "localhost", HOST, not_after=yesterday)

    def issue(self, title, *names, **limits):
        issued = self._authority.issue_cert(*names, **limits)
        paths = str(self._folder / f"{title}.crt"), str(self._folder / f"{title}.key")
        issued.cert_chain_pems[0].write_to_path(paths[0])
        issued.private_key_pem.write_to_path(paths[1])
        return paths


@pytest.fixture(scope="module")
def certificates(tmp_path_factory):
    return Certificates(tmp_path_factory.mktemp("certificates"))


@pytest.fixture(scope="module")
def other_authority(tmp_path_factory):
    return Certificates(tmp_path_factory.mktemp("others"))


def context_for(certificate, ca=None):
    context = ssl.SSLContext(ssl.PROTOCOL_TLS_SERVER)
    context.load_cert_chain(*certificate)
    if ca is not None:
        context.load_verify_locations(ca)
        context.verify_mode = ssl.CERT_REQUIRED
    return context


@pytest.fixture(scope="module")
def behind_tls(certificates):
    """Starts a real server behind a proxy that speaks TLS; yields its port."""

    @contextlib.contextmanager
    def start(certificate=certificates.server, ask=False):
        context = context_for(certificate, certificates.ca if ask else None)
        with own_server() as process, Proxy(process.port, ssl=context) as proxy:
            yield proxy.port

    return start


@pytest.fixture(scope="module")
def guarded(behind_tls):
    with behind_tls(ask=True) as port:
        yield port


@pytest.fixture(scope="module")
def shielded(behind_tls):
    with behind_tls() as port:
        yield port


def url_of(port, host="localhost"):
    return f"rediss://{host}:{port}"


def full_options(certificates):
    certfile, keyfile = certificates.robot
    return {"ssl_ca_certs": certificates.ca, "ssl_certfile": certfile, "ssl_keyfile": keyfile}


# --- it works ------------------------------------------------------------------------------------------


@both
def test_the_name_is_checked_against_the_address_too(shielded, certificates, name):
    """localhost and 127.0.0.1 are both in the certificate; options instead of a URL."""
    for host in ("localhost", HOST):
        options = {"port": shielded, "ssl": True, "ssl_ca_certs": certificates.ca}
        with contextlib.closing(FRONTS[name](host, **options)) as front:
            front.write(["foo"], 1)
            assert front.read(["foo"]) == 1


@pytest.mark.parametrize("loop", ["asyncio", "uvloop"])
def test_publishing_and_subscribing_over_tls_on_event_loops(guarded, certificates, loop):
    """The wire takes redis-py's TLS connection over, on either loop."""
    new_loop = asyncio.new_event_loop if loop == "asyncio" else pytest.importorskip("uvloop").new_event_loop

    async def follow():
        async with reem_async.RedisInterface(url_of(guarded), **full_options(certificates)) as interface:
            space = reem_async.PublishSpace(interface)
            await space["c"].write({"n": 0, "image": np.zeros(LARGE)})
            changed = np.random.default_rng(2).random(LARGE)

            async def publish():
                await space["c"]["image"].write(changed)
                await space["c"]["n"].write(1)

            async with asyncio.timeout(PATIENCE):
                updates = reem_async.KeyValueStore(interface)["c"].watch(policy=reem_async.Every(10))
                assert (await anext(updates)).initial
                publishing = asyncio.create_task(publish())
                async for update in updates:
                    if update.data["n"] == 1:
                        break
                await publishing
            assert_same(update.data["image"], changed)
            await reem_async.KeyValueStore(interface)["c"].delete()

    with asyncio.Runner(loop_factory=new_loop) as runner:
        runner.run(follow())


@both
def test_one_tls_connection_serves_many_calls(certificates, name):
    """A handshake costs more than a call; also after a pause, in which the blocking front looks at the socket."""
    with own_server() as process, Proxy(process.port, ssl=context_for(certificates.server)) as proxy:
        with contextlib.closing(FRONTS[name](url_of(proxy.port), ssl_ca_certs=certificates.ca)) as front:
            for number in range(5):
                front.write(["foo"], number)
            time.sleep(1.1)
            assert front.read(["foo"]) == 4
        own = PLAIN and name == "asyncio"  # for the look that a document takes which is not known yet
        assert proxy.connections == 1 + own


# --- what is refused ----------------------------------------------------------------------------------------


def assert_refused(name, url, *words, **options):
    """At no call is anything sent; told within a second or so, in words that help."""
    begun = time.monotonic()
    with pytest.raises(reem.TlsRefused) as caught:
        connect(name, url, **options)
    assert time.monotonic() - begun < 2
    assert isinstance(caught.value, redis.exceptions.ConnectionError)
    for word in words:
        assert word in str(caught.value)


@both
def test_a_certificate_with_another_name_is_refused(behind_tls, certificates, name):
    """Somebody else's server in its place is not talked to; nor is the right one under a wrong name."""
    with behind_tls(certificates.elsewhere) as port:
        for host in ("localhost", HOST):
            assert_refused(name, url_of(port, host), "mismatch", "name", ssl_ca_certs=certificates.ca)
        unchecked = {"ssl_ca_certs": certificates.ca, "ssl_check_hostname": False}
        connect(name, url_of(port), **unchecked)  # it was the name, and nothing else


@both
def test_an_expired_certificate_is_refused(behind_tls, certificates, name):
    with behind_tls(certificates.expired) as port:
        assert_refused(name, url_of(port), "expired", "renew", ssl_ca_certs=certificates.ca)


@both
def test_an_authority_that_is_not_known_is_refused(shielded, other_authority, name):
    """The system's authorities, and another one than the server's."""
    for options in ({}, {"ssl_ca_certs": other_authority.ca}):
        assert_refused(name, url_of(shielded), "ssl_ca_certs=", **options)


@pytest.mark.alone
@both
def test_a_sentinel_whose_authority_is_not_known_is_refused_in_the_same_words(shielded, other_authority, name):
    """However many others of the URL are just not there."""
    with socket.create_server((HOST, 0)) as taken:
        gone = taken.getsockname()[1]
    hosts = f"localhost:{gone},localhost:{shielded},localhost:{gone}"
    options = {"ssl_ca_certs": other_authority.ca}
    assert_refused(
        name, f"rediss+sentinel://{hosts}/mymaster", "certificate is not trusted", "ssl_ca_certs=", **options
    )


@both
def test_a_client_without_the_right_certificate_is_refused(guarded, certificates, other_authority, name):
    certfile, keyfile = other_authority.robot
    strange = {"ssl_certfile": certfile, "ssl_keyfile": keyfile}
    for options in ({}, strange):
        assert_refused(name, url_of(guarded), "ssl_certfile=", ssl_ca_certs=certificates.ca, **options)


@both
def test_a_server_that_does_not_speak_tls_is_told(certificates, name):
    with own_server() as process, pytest.raises(reem.NotConnected, match="does not speak TLS"):
        connect(name, url_of(process.port), ssl_ca_certs=certificates.ca)


@both
def test_a_server_that_speaks_tls_only_is_told(shielded, name):
    """The remedy is in the text; the password is not sent to a port that cannot read it."""
    with pytest.raises(reem.NotConnected, match="rediss://"):
        connect(name, f"redis://localhost:{shielded}")


def test_tls_is_1_2_or_newer(certificates):
    for version in (ssl.TLSVersion.TLSv1_1, ssl.TLSVersion.TLSv1, ssl.TLSVersion.MINIMUM_SUPPORTED, 769):
        with pytest.raises(reem.BadValue, match=r"TLS before 1\.2"):
            reem.RedisInterface("rediss://localhost", ssl_min_version=version)
    plain = reem_async.RedisInterface("rediss://localhost", ssl_ca_certs=certificates.ca).session.options
    lowest = plain.asynchronous_connection().ssl_context.get().minimum_version
    assert lowest == plain.blocking_connection().ssl_min_version == ssl.TLSVersion.TLSv1_2


def test_options_that_would_only_fail_later_are_refused_at_once(certificates, tmp_path):
    """Missing files, options of TLS without TLS, TLS where it makes no sense."""
    for option in ("ssl_ca_certs", "ssl_certfile", "ssl_keyfile"):
        with pytest.raises(reem.BadValue, match=option):
            reem.RedisInterface("rediss://localhost", **{option: str(tmp_path / "missing")})
    with pytest.raises(reem.BadType, match="rediss://"):
        reem.RedisInterface("redis://localhost", ssl_ca_certs=certificates.ca)
    with pytest.raises(reem.BadValue, match="unix"):
        reem.RedisInterface("unix:///tmp/x", ssl=True)
    with pytest.raises(reem.BadValue, match="never"):
        reem.RedisInterface("rediss://localhost", ssl_cert_reqs="never")
    with pytest.raises(reem.BadValue, match="options"):
        reem.RedisInterface("localhost", port="abc")
    for package in (reem, reem_async):  # notices and replies share a connection, which only protocol 3 can do
        with pytest.raises(reem.BadValue, match="protocol"):
            package.RedisInterface("localhost", protocol=2)


@pytest.fixture(scope="module")
def guarded_cluster(certificates):
    """Two primaries, each behind TLS that asks for certificates; yields the URL of the cluster."""
    with contextlib.ExitStack() as stack:
        nodes, proxies = [], []
        for _ in range(2):
            node = stack.enter_context(own_server("cluster-enabled yes", "cluster-announce-ip 127.0.0.1"))
            context = context_for(certificates.server, certificates.ca)
            proxies.append(stack.enter_context(Proxy(node.port, ssl=context)))
            nodes.append(stack.enter_context(node.admin()))
            nodes[-1].config_set("cluster-announce-port", proxies[-1].port)
            nodes[-1].config_set("cluster-announce-bus-port", node.port + 10000)
        nodes[0].execute_command("CLUSTER", "ADDSLOTSRANGE", 0, 8191)
        nodes[1].execute_command("CLUSTER", "ADDSLOTSRANGE", 8192, 16383)
        nodes[0].execute_command("CLUSTER", "MEET", HOST, node.port, node.port + 10000)
        for node in nodes:
            eventually(lambda node=node: "cluster_state:ok" in str(node.execute_command("CLUSTER", "INFO")))
            eventually(lambda node=node: len(node.execute_command("CLUSTER", "SLOTS")) == 2)
        yield f"rediss+cluster://localhost:{proxies[0].port}"


@both
def test_a_cluster_over_tls(guarded_cluster, certificates, name):
    """All nodes, though only one is named; keys, arrays of 8 MB, and updates."""
    with contextlib.closing(FRONTS[name](guarded_cluster, **full_options(certificates))) as front:
        image = np.random.default_rng(1).random(LARGE)
        for number in range(20):
            front.write([f"k{number}"], {"n": number, "image": image[: LARGE >> number]})
        for number in range(20):
            assert_same(front.read([f"k{number}"]), {"n": number, "image": image[: LARGE >> number]})
            front.delete([f"k{number}"])


def test_updates_through_a_cluster_over_tls(guarded_cluster, certificates):
    with reem.RedisInterface(guarded_cluster, **full_options(certificates)) as interface:
        space = reem.PublishSpace(interface)
        mirrors = [reem.SilentSubscriber(f"k{number}", interface) for number in range(6)]
        for number, mirror in enumerate(mirrors):
            mirror.listen()
            space[f"k{number}"] = {"n": number, "a": np.arange(100_000)}
        for number, mirror in enumerate(mirrors):
            eventually(lambda mirror=mirror, number=number: mirror.value() and mirror.value()["n"] == number)
            assert_same(mirror.value()["a"], np.arange(100_000))


@both
def test_a_cluster_over_tls_refuses_whoever_has_no_certificate(guarded_cluster, certificates, name):
    assert_refused(name, guarded_cluster, ssl_ca_certs=certificates.ca)
