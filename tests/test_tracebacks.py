"""Errors that say it all: the caller's line, hardly any of REEM's, and no chain of what went on inside."""

import asyncio
import contextlib
import traceback

import numpy as np
import pytest
from conftest import ROOT

import reem
import reem_async
from reem_async.errors import ConnectionLost, MissingKey, NotConnected, PathRefused
from reem_async.server import EmbeddedServer


def shown(error):
    """What Python prints of an error, and how many of its frames are REEM's."""
    ours = [
        frame.f_code.co_name
        for frame, _ in traceback.walk_tb(error.__traceback__)
        if any(frame.f_code.co_filename.startswith(str(ROOT / package)) for package in ("reem/", "reem_async/"))
    ]
    return "".join(traceback.format_exception(error)), ours


def check(error, most):
    text, ours = shown(error)
    assert len(ours) <= most, ours
    assert text.count("Traceback") == 1, text
    assert text.rstrip().split("\n")[-1] == f"{type(error).__module__}.{type(error).__name__}: {error}"


BLOCKING = {
    "read": lambda place: place["x"].read(),
    "del": lambda place: place.__delitem__("x"),
    "+=": lambda place: place["x"].__iadd__(1),
    "-=": lambda place: place["x"].__isub__(1),
    "*=": lambda place: place["x"].__imul__(2),
    "/=": lambda place: place["x"].__itruediv__(2),
    "len": lambda place: len(place["x"]),
    "in": lambda place: "y" in place["x"],
    "iter": lambda place: iter(place["x"]),
    "pop": lambda place: place.pop("x"),
    "append": lambda place: place["x"].append(1),
    "write": lambda place: place["x"]["y"].write(1),
    "item": lambda place: place["list"][5].read(),
}


@pytest.mark.parametrize("call", BLOCKING.values(), ids=BLOCKING)
def test_what_is_missing_is_said_in_a_few_lines(kvs, key, call):
    kvs[key()] = {"n": 1, "list": []}
    with pytest.raises((MissingKey, PathRefused)) as caught:
        call(kvs[key()])
    check(caught.value, 2)


ASYNCIO = {
    "read": (1, lambda place: place["x"].read()),
    "item": (1, lambda place: place["list"][5].read()),
    "delete": (3, lambda place: place["x"].delete()),
    "increment": (3, lambda place: place["x"].increment()),
    "length": (3, lambda place: place["x"].length()),
    "contains": (3, lambda place: place["x"].contains("y")),
    "keys": (3, lambda place: place["x"].keys()),
    "pop": (4, lambda place: place.pop("x")),
    "append": (3, lambda place: place["x"].append(1)),
    "append an array": (3, lambda place: place["x"].append(np.zeros(1))),
    "write": (3, lambda place: place["x"]["y"].write(1)),
    "write an array": (4, lambda place: place["x"]["y"].write(np.zeros(1))),
}


@pytest.mark.parametrize(("most", "call"), ASYNCIO.values(), ids=ASYNCIO)
async def test_asyncio_does_so_too(akvs, key, most, call):
    """With the coroutines on the way to it, as far as they cannot be left out."""
    await akvs[key()].write({"n": 1, "list": []})
    with pytest.raises((MissingKey, PathRefused)) as caught:
        await call(akvs[key()])
    check(caught.value, most)


def test_a_publisher_whose_server_is_gone_says_so_in_one_line():
    with EmbeddedServer() as server, reem.RedisInterface(server.url) as interface:
        space = reem.PublishSpace(interface)
        space["a"] = {"n": 1}
        port = server.port
        server.__exit__(None, None, None)
        for call in (lambda: space["a"]["n"].write(1), lambda: space["a"].update(n=1), lambda: space["b"].delete()):
            with pytest.raises((NotConnected, ConnectionLost)) as caught:
                call()
            check(caught.value, 2)
        assert str(caught.value).startswith(f"no server answers at 127.0.0.1:{port} (Connection refused)")


async def test_of_several_calls_that_share_a_failure_each_says_so_in_one_line():
    async with asyncio.timeout(10):
        store = reem_async.PublishSpace(reem_async.RedisInterface("redis://127.0.0.1:1"))
        calls = [store[f"k{number}"].write(1) for number in range(3)]
        for error in await asyncio.gather(*calls, return_exceptions=True):
            assert isinstance(error, NotConnected)
            assert error.__cause__ is None
            assert len(shown(error)[1]) <= 3


def test_a_program_that_starts_before_its_server_says_so_in_a_few_lines():
    async def connect():
        async with reem_async.RedisInterface("redis://127.0.0.1:1"):
            pass

    with pytest.raises(NotConnected) as caught:
        asyncio.run(connect())
    check(caught.value, 2)
    with pytest.raises(NotConnected) as caught, reem.RedisInterface("redis://127.0.0.1:1"):
        pass
    check(caught.value, 4)


FOLLOWING = {
    "mirror": lambda interface: reem.SilentSubscriber("a", interface).listen(),
    "callback": lambda interface: reem.CallbackSubscriber("a", interface, print, {}).listen(),
    "watch": lambda interface: next(iter(reem.KeyValueStore(interface)["a"].watch())),
}


@pytest.mark.parametrize("begin", FOLLOWING.values(), ids=FOLLOWING)
def test_a_subscriber_that_starts_before_its_server_says_so_in_a_few_lines(begin):
    interface = reem.RedisInterface("redis://127.0.0.1:1")
    with contextlib.closing(interface), pytest.raises(NotConnected) as caught:
        begin(interface)
    check(caught.value, 7)
