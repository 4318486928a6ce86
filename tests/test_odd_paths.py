"""Paths that no robot has, and whoever types a link may ask for: each is addressed exactly or refused, and nothing
that REEM sends for them ends the server."""

from __future__ import annotations

import itertools
import json

import pytest
import redis
from conftest import FRONTS, BlockingFront

import reem
import reem_async
from reem_async.errors import BadKey, ReemError
from reem_async.plan.paths import check_element, to_jsonpath
from reem_async.server import EmbeddedServer
from reem_async.store.catalog import outline
from reem_async.tools.browser.partial_reads import keys_at, noted_texts, peek
from reem_async.tools.recording.fetch import fetch

# U+4E00, U+AC00, U+0100, U+1F600, U+10000: at code points that end in 00 the RedisJSON module has died.
ODD = ["", "\0", "\x01", "\n", "\r", "\t", " ", "\x7f", "\xa0", "Ā", "\u2028", "一", "가", "\ufeff", "😀", "\U00010000"]
ODD += ["\U0010ffff", "*", "?(@)", "$", "..", "]", "[", "%s%n", "a,b", 'a"b', "a'b", "a" * 3000, "一" * 300, "二", "@"]
INDEXES = [0, 1, -1, -2, -3, 2**31, -(2**31) - 1, 2**63 - 1, -(2**63)]
UNADDRESSABLE = [" ", " x", "  x", "a\\b", "\"'", 2**63, 2**64, 10**30, -(2**63) - 1]
PARSER = "Error occurred on position"
"""What the server says of a path that it cannot read."""
STATES = {"absent": None, "text": "t", "number": 1, "list": [1, {"一": [1]}], "dict": {"a": {"b": 1}, "一": [[1], {}]}}

CALLS = {
    "read": lambda front, path: front.read(path),
    "length": lambda front, path: front.length(path),
    "type": lambda front, path: front.type(path),
    "increment": lambda front, path: front.increment(path, 1),
    "divide": lambda front, path: front.divide(path, 2),
    "extend": lambda front, path: front.extend(path, [1]),
    "write": lambda front, path: front.write(path, 1),
    "delete": lambda front, path: front.delete(path),
}


@pytest.fixture(scope="module")
def server():
    with EmbeddedServer() as running:
        yield running


def odd_paths():
    elements = [*ODD, *INDEXES]
    yield from ([element] for element in elements)
    yield from ([first, element] for first in ("a", "一", -1, -2) for element in elements)
    yield [*["一", -2] * 20]


@pytest.mark.parametrize("space", ["KeyValueStore", "PublishSpace"])
@pytest.mark.parametrize("state", STATES)
def test_no_path_ends_the_server(server, state, space):
    calls = [*CALLS] if space == "KeyValueStore" else ["increment", "divide", "extend", "write", "delete"]
    with redis.Redis(unix_socket_path=server.socket_path) as raw:
        front, said = BlockingFront(server.url, space), []
        for path in odd_paths():
            raw.delete("foo", "{foo}:ships")
            if STATES[state] is not None:
                raw.execute_command("JSON.SET", "foo", "$", json.dumps(STATES[state]))
            for name in calls:
                try:
                    CALLS[name](front, ["foo", *path])
                except (ReemError, redis.ResponseError, TypeError, ZeroDivisionError) as error:
                    said.append((name, path, str(error)))
        front.close()
        assert server.running
        assert [each for each in said if PARSER in each[-1]] == []


async def test_no_path_of_a_page_or_a_notice_ends_the_server(server):
    """They look at paths that others have named."""
    asks = (
        lambda session, path: peek(session, [path]),
        keys_at,
        lambda session, path: noted_texts(session, [path]),
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


@pytest.mark.parametrize("element", UNADDRESSABLE, ids=repr)
@pytest.mark.parametrize("front", FRONTS)
def test_what_cannot_be_addressed_is_refused_everywhere(server, element, front):
    opened = FRONTS[front](server.url)
    opened.write(["foo"], {"x": "important", "": "too"})
    for call in CALLS.values():
        with pytest.raises(BadKey, match="foo"):
            call(opened, ["foo", element])
        with pytest.raises(BadKey):
            call(opened, ["foo", "x", element, "y"])
        assert opened.read(["foo"]) == {"x": "important", "": "too"}
    with pytest.raises(BadKey):
        to_jsonpath(("x", element))
    opened.close()


def test_a_mirror_refuses_them_too(server):
    with reem.RedisInterface(server) as interface:
        with pytest.raises(BadKey):
            reem.SilentSubscriber("foo. x", interface)
        with pytest.raises(BadKey):
            reem.SilentSubscriber("foo", interface)[" x"]


def test_a_top_level_key_may_begin_with_a_space(server):
    with reem.RedisInterface(server) as interface:
        kvs = reem.KeyValueStore(interface)
        kvs[" foo"] = {"x": 1}
        kvs["foo"] = {"x": 2}
        assert (kvs.get(" foo.x"), kvs[" foo"]["x"].read(), kvs["foo"]["x"].read()) == (1, 1, 2)


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
