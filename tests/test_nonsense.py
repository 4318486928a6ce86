"""A peer that is no server, or a broken one: its replies cost an error of REEM's own, never one of Python's."""

from __future__ import annotations

import contextlib

import pytest
import redis
from conftest import FRONTS
from own_servers import caller, liar

import reem

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
    """Whatever it says; a greeting that is not ended costs a second."""
    endless = ("a length", "a count", "zeros", "an empty push")
    for title, reply in NONSENSE.items():
        if not title.startswith(endless):
            peer = liar(lambda words, reply=reply: reply, greets=False)
            with peer as url, caller(name, url) as made, pytest.raises(reem.ReemError):
                made(made.calls[1])
