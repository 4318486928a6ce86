"""A peer that is no server, or a broken one: its replies cost an error of REEM's own, never one of Python's."""

import contextlib

import numpy as np
import pytest
import redis
from conftest import FRONTS
from own_servers import caller, liar

import reem
import reem_async

both = pytest.mark.parametrize("name", list(FRONTS))

NONSENSE = {
    "a status": b"+OK\r\n",
    "a number": b":1\r\n",
    "nothing": b"_\r\n",
    "a nil string": b"$-1\r\n",
    "a nil list": b"*-1\r\n",
    "an empty list": b"*0\r\n",
    "an empty string": b"$0\r\n\r\n",
    "not JSON": b"$3\r\nabc\r\n",
    "other JSON": b"$5\r\n[1,2]\r\n",
    "a placeholder": b'$28\r\n["$ship numpy .image 99 f8"]\r\n',
    "half a placeholder": b'$11\r\n["$ship x"]\r\n',
    "not UTF-8": b"$4\r\n\xff\xfe\xfd\xfc\r\n",
    "a float": b",1.5\r\n",
    "a bool": b"#t\r\n",
    "a map": b"%1\r\n+a\r\n*1\r\n:1\r\n",
    "a map with a list for a key": b"%1\r\n*1\r\n:1\r\n:1\r\n",
    "a set": b"~1\r\n*1\r\n:1\r\n",
    "lists in lists": b"*1\r\n" * 60 + b":1\r\n",
    "a list of the wrong things": b"*3\r\n:1\r\n+x\r\n_\r\n",
    "an error": b"-ERR no\r\n",
    "an error without a code": b"-\r\n",
    "an error that redis-py takes apart": b"-MOVED x\r\n",
    "another one": b"-ASK 1 2 3 4\r\n",
    "an error that is not UTF-8": b"-OOM \xff\xfe\r\n",
    "a big number": b"(99999999999999999999999999\r\n",
    "a push": b">1\r\n+hello\r\n+OK\r\n",
    "an empty push": b">0\r\n+OK\r\n",
    "a push of lists": b">3\r\n*1\r\n:1\r\n*1\r\n:1\r\n*1\r\n:1\r\n+OK\r\n",
    "a web page": b"HTTP/1.1 400 Bad Request\r\nServer: x\r\n\r\n",
    "zeros": b"\0" * 64,
    "a length that is none": b"$abc\r\n",
    "a negative length": b"$-7\r\nabc\r\n",
    "a negative count": b"*-7\r\n",
    "a length beyond all memory": b"$999999999999999999\r\nabc",
    "a length of 100 GB": b"$100000000000\r\nabc",
    "a count beyond all memory": b"*4000000000000\r\n:1\r\n",
    "a length with no end": b"$" + b"9" * 5000,
    "two replies": b"+OK\r\n+OK\r\n",
    "a length of 100 GB and the beginning": b"$100000000000\r\n" + b"x" * 9000,
    "a count of a billion and the beginning": b"*1000000000\r\n" + b":1\r\n" * 3000,
    "a map of a billion": b"%1000000000\r\n" + b":1\r\n" * 3000,
    "a count of -5": b"*-5\r\n",
    "a map of -5": b"%-5\r\n",
    "a push of -5": b">-5\r\n",
    "a number of a million digits": b":" + b"9" * 1_000_000 + b"\r\n",
    "a big number of a million digits": b"(" + b"9" * 1_000_000 + b"\r\n",
    "a million lists in lists": b"*1\r\n" * 1_000_000,
    "a million pushes in pushes": b">1\r\n" * 1_000_000,
    "a streamed string": b"$?\r\n;4\r\nabcd\r\n;0\r\n",
    "a streamed list": b"*?\r\n:1\r\n.\r\n",
    "an attribute": b"|1\r\n+k\r\n+v\r\n$5\r\n[1.5]\r\n",
    "a verbatim string": b"=15\r\ntxt:Some string\r\n",
    "an error as a bulk string": b"!9\r\nERR nope!\r\n",
    "a place that is none": b"-MOVED 1 \r\n",
    "no place": b"-MOVED\r\n",
    "a slot that is none": b"-MOVED x 127.0.0.1:1\r\n",
    "a slot beyond all": b"-MOVED 999999999999 127.0.0.1:1\r\n",
    "a port that is none": b"-ASK 1 127.0.0.1:x\r\n",
    "values 900 deep": b"$1802\r\n" + b"[" * 901 + b"]" * 901 + b"\r\n",
    "values 5000 deep": b"$10000\r\n" + b"[" * 5000 + b"]" * 5000 + b"\r\n",
    "the end": None,
}


@both
@pytest.mark.parametrize("reply", NONSENSE.values(), ids=list(NONSENSE))
def test_a_peer_that_talks_nonsense_costs_an_error_of_reems_own(name, reply, caplog):
    """Never an error of Python's, at no call, and nothing in the event loop's log."""
    with liar(lambda words: reply) as url, caller(name, url, timeout=0.02) as made:
        for call in made.calls:
            with contextlib.suppress(reem.ReemError, redis.exceptions.RedisError):
                made(call)
    assert [record for record in caplog.records if record.name == "asyncio"] == []


@both
def test_a_peer_that_does_not_greet_like_a_server_is_not_connected_to(name):
    endless = ("a length", "a count", "zeros", "an empty push")
    for title, reply in NONSENSE.items():
        if not title.startswith(endless):
            peer = liar(lambda words, reply=reply: reply, greets=False)
            with peer as url, caller(name, url) as made, pytest.raises(reem.ReemError):
                made(made.calls[1])


PLACES = [b"-MOVED 1 \r\n", b"-MOVED\r\n", b"-ASK 1 \r\n", b"-MOVED x 127.0.0.1:1\r\n", b"-MOVED 1 127.0.0.1:1\r\n"]


@both
@pytest.mark.parametrize("reply", PLACES)
def test_a_server_that_sends_on_to_another_one_costs_an_error_of_reem(name, reply):
    """Also if what it says leads nowhere: one of redis-py's own would not be caught as ReemError."""
    with liar(lambda words: reply) as url, caller(name, url) as made:
        for call in made.calls:
            with pytest.raises(reem.ClusterNode, match="Redis Cluster"):
                made(call)


def wanted(*replies):
    """Answers JSON.GET and transactions with a reply, the look for old data with nothing, all else with OK."""
    known = {b"JSON.GET": replies[0], b"EXEC": replies[0], b"JSON.TYPE": b"*0\r\n"}
    return lambda words: known.get(words[0], b"+OK\r\n")


ENDLESS = {
    "a string that is announced": b"$99999999999\r\n" + b"x" * 9000,
    "a string over the limit": b"$20971520\r\n" + b"x" * (20 << 20),
    "a line": b"+" + b"x" * (20 << 20),
    "many strings": b"*100000\r\n" + (b"$1000\r\n" + b"x" * 1000 + b"\r\n") * 30_000,
    "a string in a list": b"*2\r\n$3\r\nabc\r\n$41943040\r\n" + b"x" * (40 << 20),
    "a list": b"*999999999\r\n" + b":1\r\n" * 100_000,
    "pushes": b">2\r\n+a\r\n$1000\r\n" + b"x" * 1000 + b"\r\n",
}


@both
@pytest.mark.parametrize("title", [title for title in ENDLESS if title != "pushes"])
def test_a_reply_that_is_too_large_is_refused_before_it_is_held(name, title):
    """With a limit of a megabyte: the connection is closed and the next call has a new one."""
    replies = [ENDLESS[title]]
    peer = liar(lambda words: wanted(*replies)(words))
    with peer as url, contextlib.closing(FRONTS[name](url, largest_value=1 << 20, timeout=20)) as front:
        with pytest.raises(reem.ConnectionLost, match=r"is the limit|more replies"):
            front.read(["a"])
        replies[0] = b"$5\r\n[1.5]\r\n"
        assert front.read(["a"]) == 1.5


@both
def test_a_flood_of_pushes_ends_a_call(name):
    """Bytes that move are no progress of its reply."""
    peer = liar(wanted(ENDLESS["pushes"] * 30_000))
    with (
        peer as url,
        contextlib.closing(FRONTS[name](url, largest_value=1 << 20, timeout=20)) as front,
        pytest.raises(reem.ConnectionLost),
    ):
        front.read(["a"])


@pytest.mark.parametrize("module", [reem, reem_async])
def test_a_limit_that_is_none_is_refused(module):
    for wrong in (0, -1, 1000, 1.5, "many", None, True):
        with pytest.raises(reem.BadValue, match="largest_value"):
            module.RedisInterface("redis://127.0.0.1:1", largest_value=wrong)
    module.RedisInterface("redis://127.0.0.1:1?largest_value=2000000")


@both
def test_many_arrays_together_are_more_than_one_may_be(name, server_url, key):
    """The limit is one for each; what is over it says how to raise it."""
    arrays = {f"a{number}": np.full(1_000_000, number, np.uint8) for number in range(7)}
    with contextlib.closing(FRONTS[name](server_url, largest_value=1 << 20)) as front:
        front.write([key("foo")], arrays)
        found = front.read([key("foo")])
        assert all((found[each] == arrays[each]).all() for each in arrays)
        front.write([key("foo")], {"a": np.zeros(1 << 20, np.uint8)})
        with pytest.raises(reem.ConnectionLost, match="largest_value"):
            front.read([key("foo"), "a"])
    with contextlib.closing(FRONTS[name](server_url)) as front:
        assert front.read([key("foo"), "a"]).size == 1 << 20
