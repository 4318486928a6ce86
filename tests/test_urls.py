"""URLs of servers: each part counts, and what no part is for is refused. The seed is printed."""

import itertools
import os
import random
import time
import traceback

import pytest

import reem
from reem_async.transport.options import Options

SEED = int(os.environ.get("REEM_TEST_SEED", time.time_ns() % 10**6))

pytestmark = pytest.mark.filterwarnings("ignore::reem.InsecureConnection")

WRONG = {
    "unix://redis.sock": "no path",
    "unix://run/redis.sock": "a host in a path",
    "unix:///": "no path",
    "unix:///run/redis.sock#1": "a fragment",
    "unix:///run/redis.sock?db=-1": "no database",
    "redis:///run/redis.sock": "a path of a socket",
    "redis://localhost:6379/robot1": "no number",
    "redis://localhost:6379/1/2": "two numbers",
    "redis://localhost:6379/-1": "no database",
    "redis://localhost:6379/1?db=2": "two databases",
    "redis://localhost:6379/?db=one": "no number",
    "redis://localhost:6379/?db=": "no number",
    "redis://localhost:6379/?db=1&db=2": "two databases",
    "redis://[::1": "half an IPv6 address",
    "redis+cluster://[::1": "half an IPv6 address",
    "redis+sentinel://[::1:26379/mymaster": "half an IPv6 address",
    "redis+cluster://me:secret@one:7000,me:secret@two:7001": "a user for each host",
    "redis://localhost:6379#3": "a fragment",
    "redis://localhost:0": "no port",
    "redis://localhost:": "no port",
    "redis://local host": "a space",
    "redis://one:6379,two:6379": "several hosts",
    "rediss://localhost/robot1": "no number",
    "redis+cluster://localhost:7000/1": "a cluster has one database",
    "redis+cluster://localhost:7000/robot": "no number",
    "redis+cluster://localhost:7000#x": "a fragment",
    "redis+cluster://": "no host",
    "redis+cluster://user:secret@127.0.0.1:7000,h:x": "no port",
    "redis+sentinel://user:secret@localhost:26379": "no service",
    "redis+sentinel://localhost:26379/mymaster/robot": "no number",
    "redis+sentinel://localhost:26379/mymaster/1/2": "two numbers",
    "redis+sentinel://localhost:26379/mymaster#x": "a fragment",
    "http://localhost": "another scheme",
    "redis://user:secret@host:notaport/0": "no port",
    "redis://user:secret/@host:6379": "a slash in the password",
    "redis://user:6379secret#@host": "a fragment in the password",
    "redis://user:secret@host:6379/0?db=x": "no number",
    "redis://user:secret@[host:6379/0": "half an IPv6 address",
    "http://user:secret@host": "another scheme",
    "redis+tls://user:secret@host": "another scheme",
}


@pytest.mark.parametrize("url", WRONG)
def test_a_url_with_a_part_that_means_nothing_is_refused(url):
    """The message says what form is expected, and never the password."""
    with pytest.raises(reem.BadValue, match=r"://|namespace=") as raised:
        reem.RedisInterface(url)
    shown = traceback.format_exception(raised.value)
    assert "secret" not in "".join(line for line in shown if not line.lstrip().startswith("File"))


def test_every_part_of_a_generated_url_counts():
    """What is made of a URL is what it was put together from; with one part more it is refused."""
    rng = random.Random(SEED)
    logins = {"": (None, None), "me:secret@": ("me", "secret"), ":s%40cret%23@": (None, "s@cret#")}
    hosts = {"localhost": "localhost", "robot1.local": "robot1.local", "[::1]": "::1", "10.0.0.7": "10.0.0.7"}
    for scheme, login, host, port, database in itertools.product(
        ("redis", "rediss"), logins, hosts, ("", ":7000"), ("", "/", "/0", "/3", "?db=5")
    ):
        url = f"{scheme}://{login}{host}{port}{database}"
        made = Options(url, 1.0, {})
        assert made.settings["host"] == hosts[host], (SEED, url)
        assert made.settings.get("port", 6379) == int(port[1:] or 6379), (SEED, url)
        assert (made.settings.get("username"), made.settings.get("password")) == logins[login], (SEED, url)
        assert (made.database, made.tls) == (int(database.strip("/?db=") or 0), scheme == "rediss"), (SEED, url)
        more = rng.choice(["/more", "#more", "/-2", "/1/2"])
        with pytest.raises(reem.BadValue) as raised:
            Options(url.partition("?")[0].rstrip("/") + more, 1.0, {})
        assert "cret" not in str(raised.value), (SEED, url, more)
    for login, path, query in itertools.product(logins, ("/run/redis.sock", "/tmp/a b.sock"), ("", "?db=2")):
        made = Options(f"unix://{login}{path}{query}", 1.0, {})
        assert (made.socket_path, made.database) == (path, 2 if query else 0)
