"""What is too large for the server is refused before it is sent: the server would only close the connection."""

import tracemalloc

import numpy as np
import pytest
import redis
from conftest import url_of_user

import reem_async
from reem_async.errors import BadValue
from reem_async.plan.sizes import USUAL, Limits, check_sizes, limits
from reem_async.server import EmbeddedServer


def untouched(size):
    """An array of so many bytes, of which the kernel makes none before somebody looks at them."""
    return np.zeros(size, np.uint8)


@pytest.mark.parametrize("space", ["KeyValueStore", "PublishSpace"])
def test_an_array_that_no_server_takes_is_refused(open_front, front, key, space):
    writer, too_large = open_front(space), untouched(USUAL.argument - 100)  # its header has 128 bytes
    front.write([key()], {"keep": [1]})
    for call in (
        lambda: writer.write([key(), "image"], too_large),
        lambda: writer.write([key(), "keep", 0], {"image": too_large}),
        lambda: writer.append([key(), "keep"], too_large),
    ):
        with pytest.raises(BadValue, match=f"{key()}.*536870940 bytes .* 536870912"):
            call()
    assert front.read([key()]) == {"keep": [1]}


@pytest.mark.parametrize("size", [2 << 30, 10**13])
def test_a_broadcast_array_is_refused_before_it_is_copied_out(front, key, size):
    """It takes one byte of memory; packed, it would take all there is."""
    tracemalloc.start()
    try:
        with pytest.raises(BadValue, match=f"{key()}.*{size} bytes"):
            front.write([key()], np.broadcast_to(np.uint8(7), (size,)))
        assert tracemalloc.get_traced_memory()[1] < 10e6
    finally:
        tracemalloc.stop()


@pytest.mark.parametrize("space", ["KeyValueStore", "PublishSpace"])
def test_a_call_that_no_server_takes_is_refused(open_front, front, key, space):
    writer, parts = open_front(space), [untouched(400 << 20)] * 3
    front.write([key()], [1])
    for call in (lambda: writer.write([key()], parts), lambda: writer.extend([key()], parts)):
        with pytest.raises(BadValue, match=f"{key()}.*several calls"):
            call()
    assert front.read([key()]) == [1]


async def test_an_edit_that_no_server_takes_is_refused(akvs, key):
    await akvs[key()].write({"keep": 1})
    with pytest.raises(BadValue, match=key()):
        async with akvs[key()].edit() as value:
            value["image"] = untouched(513 << 20)
    assert await akvs[key()].read() == {"keep": 1}


async def test_the_servers_own_limits_count():
    with EmbeddedServer() as server, redis.Redis(unix_socket_path=server.socket_path) as raw:
        raw.config_set("proto-max-bulk-len", 3 << 29)
        raw.config_set("client-query-buffer-limit", 5 << 29)
        raw.execute_command("ACL", "SETUSER", "guest", "on", ">word", "~*", "&*", "+@all", "-config")
        async with reem_async.RedisInterface(server) as interface:
            assert await interface.session.run(limits()) == Limits(3 << 29, 5 << 29)
        async with reem_async.RedisInterface(url_of_user(server.url, "guest", "word")) as interface:
            assert await interface.session.run(limits()) == USUAL


def test_both_limits_are_kept_to():
    check_sizes([("a", 512 << 20), ("b", 511 << 20)], USUAL)
    for sizes in ([("a", (512 << 20) + 1)], [("a", 512 << 20), ("b", 512 << 20)]):
        with pytest.raises(BadValue, match=r"^a: "):
            check_sizes(sizes, USUAL)
        check_sizes(sizes, Limits(2 << 30, 2 << 30))
