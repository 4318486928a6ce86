"""Objects that own file descriptors: copies close none, and numbers that are other files' stay open."""

from __future__ import annotations

import collections
import copy
import dataclasses
import gc
import os
import pickle

import pytest

import reem
from reem_async.concurrency.locks import wakeups


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
    for each in (watch, states):  # as a thread that has waited leaves it
        each._core.queue._idle.setdefault(os.getpid(), collections.deque()).append(wakeups())
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
