"""Objects that own file descriptors: copies close none, and numbers that are other files' stay open."""

from __future__ import annotations

import copy
import dataclasses
import gc
import os
import pickle
import select

import pytest

import reem
from reem_async.concurrency.wakeup import wakeups
from reem_async.local.host import reason_against
from reem_async.local.segment import Segment


@dataclasses.dataclass
class Robot:
    part: object


COPIES = {
    "copy": copy.copy,
    "deepcopy": lambda owner: copy.deepcopy({"robot": owner}),
    "pickle": pickle.dumps,
    "asdict": lambda owner: dataclasses.asdict(Robot(owner)),
}


def descriptors():
    gc.collect()
    return {name: os.readlink(f"/proc/self/fd/{name}") for name in os.listdir("/proc/self/fd") if is_open(name)}


def is_open(name):
    return os.path.lexists(f"/proc/self/fd/{name}")


@pytest.mark.skipif(not os.path.isdir("/proc/self/fd"), reason="counts descriptors in /proc")
@pytest.mark.parametrize("way", COPIES)
def test_a_copy_of_what_follows_or_waits_closes_no_descriptor(interface, key, way):
    """It is refused, or a handle of its own; the original goes on."""
    kvs, space, heard = reem.KeyValueStore(interface), reem.PublishSpace(interface), []
    kvs[key()] = 1
    watch, states = kvs[key()].watch(), interface.states()
    next(watch), next(states)
    watch._core.queue._wakeup(), states._core.queue._wakeup()  # as a thread that waits makes them
    callback = reem.CallbackSubscriber(key(), interface, lambda data, updated_path: heard.append(data))
    callback.listen()
    with kvs[key()].mirror() as mirror:
        before = descriptors()
        for owner in (watch, states, mirror, callback, interface, watch._core.queue, wakeups()):
            try:
                COPIES[way](owner)
            except (TypeError, AttributeError, pickle.PicklingError):  # as Python says it of what has no copies
                continue
        assert before.items() <= descriptors().items()
        space[key()] = 2
        assert next(watch).data == 2
        mirror.wait_until(lambda value: value == 2, 10)


@pytest.mark.parametrize("kind", ["wakeups", "segment"])
def test_a_number_that_is_another_file_by_then_is_neither_written_nor_closed(tmp_path, kind):
    """As in a program that becomes a daemon, closes all descriptors and opens files of its own."""
    if kind == "segment" and reason_against():
        pytest.skip(reason_against())
    owner = wakeups() if kind == "wakeups" else Segment(1000)
    number = owner._write.number if kind == "wakeups" else owner.descriptor
    with open(tmp_path / "file", "w+b") as file:
        os.dup2(file.fileno(), number)
        if kind == "wakeups":
            owner.put(None)
        del owner
        gc.collect()
        os.write(number, b"mine")
        os.close(number)
        file.seek(0)
        assert file.read() == b"mine"


@pytest.mark.parametrize("kind", ["wakeups", "epoll"])
def test_numbers_that_are_those_of_another_watch_or_an_epoll_by_then_are_not_closed(kind):
    """A daemon's next watch, or event loop, often gets the number."""
    owner = wakeups()
    ends = [owner._read.number, owner._write.number]
    for number in ends:
        os.close(number)
    others = [wakeups()] if kind == "wakeups" else [select.epoll(), select.epoll()]
    owner.put(None)
    del owner
    gc.collect()
    if kind == "wakeups":
        assert [others[0]._read.number, others[0]._write.number] == ends
        others[0].put(None)
        others[0].get()
    else:
        assert [other.fileno() for other in others] == ends
        assert [other.poll(0) for other in others] == [[], []]
