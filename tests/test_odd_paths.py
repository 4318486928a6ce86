"""Paths that no robot has, and whoever types a link may ask for: each is addressed exactly or refused, and nothing
that REEM sends for them ends the server."""

import itertools
import json

import pytest
import redis

import reem
import reem_async
from reem_async.errors import BadKey, ReemError
from reem_async.plan.paths import check_element, to_jsonpath
from reem_async.server import EmbeddedServer
from reem_async.store.catalog import outline
from reem_async.tools.browser.partial_reads import keys_at, peek
from reem_async.tools.recording.key_recorder import fetch

# U+4E00, U+AC00, U+0100, U+1F600, U+10000: at code points that end in 00 the RedisJSON module has died.
ODD = ["", "\0", "\x01", "\n", "\r", "\t", " ", "\x7f", "\xa0", "Ā", "\u2028", "一", "가", "\ufeff", "😀", "\U00010000"]
ODD += ["\U0010ffff", "*", "?(@)", "$", "..", "]", "[", "%s%n", "a,b", 'a"b', "a'b", "a" * 3000, "一" * 300, "二", "@"]
INDEXES = [0, 1, -1, -2, -3, 2**31, -(2**31) - 1, 2**63 - 1, -(2**63)]
UNADDRESSABLE = [" ", " x", "  x", "a\\b", "\"'", 2**63, 2**64, 10**30, -(2**63) - 1]
PARSER = "Error occurred on position"
"""What the server says of a path that it cannot read."""


@pytest.fixture(scope="module")
def server():
    with EmbeddedServer() as running:
        yield running


def odd_paths():
    elements = [*ODD, *INDEXES]
    yield from ([element] for element in elements)
    yield from ([first, element] for first in ("a", "一", -1, -2) for element in elements)
    yield [*["一", -2] * 20]


async def test_no_path_of_a_page_or_a_notice_ends_the_server(server):
    """They look at paths that others have named."""
    asks = (
        lambda session, path: peek(session, [path]),
        keys_at,
        lambda session, path: fetch(session, session.keys(path[0]), path[1:]),
        lambda session, path: outline(session.interface, path),
    )
    said = []
    async with reem_async.RedisInterface(server) as interface:
        for value in ({"a": {}, "一": {"b": 1}}, [{"一": {}}], None):
            for path in [*odd_paths(), *([each] for each in UNADDRESSABLE)]:
                if value is None:
                    with redis.Redis(unix_socket_path=server.socket_path) as raw:
                        raw.delete("foo")
                else:
                    await reem_async.KeyValueStore(interface)["foo"].write(value)
                for ask in asks:
                    try:
                        await ask(interface.session, ("foo", *path))
                    except (ReemError, redis.ResponseError) as error:
                        said.append((path, str(error)))
    assert server.running
    assert [each for each in said if PARSER in each[-1]] == []


def test_a_mirror_refuses_them_too(server):
    with reem.RedisInterface(server) as interface:
        with pytest.raises(BadKey):
            reem.SilentSubscriber("foo. x", interface)
        with pytest.raises(BadKey):
            reem.SilentSubscriber("foo", interface)[" x"]


def assert_exact(raw, keys):
    """Each key that may be sent leads to its own value and to nothing else, read and written."""
    keys = sorted(set(keys))
    paths = {key: to_jsonpath((key,)) for key in keys}
    raw.execute_command("JSON.SET", "foo", "$", json.dumps({key: number for number, key in enumerate(keys)}))
    raw.execute_command("JSON.SET", "bar", "$", "{}")
    pipe = raw.pipeline(transaction=False)
    for key in keys:
        pipe.execute_command("JSON.GET", "foo", paths[key])
    for number, key in enumerate(keys):
        pipe.execute_command("JSON.SET", "bar", paths[key], str(number))
    replies = pipe.execute()
    assert [key for number, key in enumerate(keys) if replies[number] != b"[%d]" % number] == []
    assert json.loads(raw.execute_command("JSON.GET", "bar")) == {key: number for number, key in enumerate(keys)}


def addressable(key):
    try:
        return bool(check_element(key, ())) or not key
    except BadKey:
        return False


@pytest.mark.long
def test_each_short_key_of_odd_characters_is_addressed_exactly_or_refused(server):
    odd = [*" \t\n\r\v\f\0\x85\xa0\u200b\u3000\ufeff'\"\\[]()*$@?.,:-~{}0a一😀"]
    keys = {"".join(each) for length in (1, 2, 3) for each in itertools.product(odd, repeat=length)}
    with redis.Redis(unix_socket_path=server.socket_path) as raw:
        chosen = [key for key in keys if addressable(key)]
        for start in range(0, len(chosen), 2000):
            assert_exact(raw, chosen[start : start + 2000])
    refused = keys - {*chosen}
    assert all(key[0] == " " or "\\" in key or {*"\"'"} <= {*key} for key in refused)


@pytest.mark.long
def test_each_character_first_last_or_alone_is_addressed_exactly_or_refused(server):
    with redis.Redis(unix_socket_path=server.socket_path) as raw:
        for start in range(0, 0x10000, 0x1000):
            characters = [chr(code) for code in range(start, start + 0x1000) if not 0xD800 <= code < 0xE000]
            keys = [key for each in characters for key in (each, f"{each}a", f"a{each}") if addressable(key)]
            if keys:
                assert_exact(raw, keys)
