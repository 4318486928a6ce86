"""A recorder that cannot keep up: what it drops is read anew, and never taken for something that was only stored."""

import asyncio
import threading

import pytest
from conftest import PATIENCE, aeventually
from test_recording_stored import is_followed, news, recording

import reem_async
from reem_async.concurrency.queues import BoundedQueue, Last
from reem_async.plan.paths import parse_pattern
from reem_async.tools.recording import Recorder, open_log
from reem_async.tools.recording.format import Kind, Role
from reem_async.tools.recording.sink import Sink
from reem_async.tools.recording.writer_thread import Operation, WriterThread


class Writing:
    """A writing thread that begins when all has been handed over: whatever becomes of it is one order of events."""

    def __init__(self, file):
        self._file = file
        ships = reem_async.RedisInterface("redis://127.0.0.1:1").session.ships  # of one that never connects
        sink = Sink(file, "none", {}, overwrite=False)
        sink.output.appear()
        self.thread = WriterThread(sink, ships, 1 << 20, [parse_pattern("*")])
        self._time = 0

    def put(self, role, value, *path, kind=Kind.PUBLISHED, room=True):
        """Hand over a change of the key `a`; without room it is dropped."""
        self._time += 1_000_000
        self.thread._limit = 1 << 20 if room else 0
        stamp = (self._time, self._time, 0)
        assert self.thread.put(Operation(role, ("a", *path), value, stamp, kind), 0) is room
        if not room:
            assert self.thread.behind == {"a"}
            self.thread.behind.clear()  # the recorder takes note, and has the key read anew

    def told(self):
        self.thread.start()
        self.thread.stop({})
        assert self.thread.failure is None
        return news(self._file)


KINDS = {Role.STORED: Kind.STORED, Role.UPDATE: Kind.PUBLISHED}
BEGINNING = ("a", "kvs", {"n": 0, "p": 0})


@pytest.mark.parametrize(
    ("then", "told"),
    [
        (  # a look that was under way has it too; from the next read of all on, stored changes are told as such again
            [(Role.UPDATE, 1, "p", False), (Role.STORED, {"n": 0, "p": 1}), (Role.STORED, {"n": 1, "p": 1})],
            [("a", "kvs", {"n": 0, "p": 1}), ("a.n", "stored", 1)],
        ),
        (  # stored before something was dropped: it waits to be written, and lacks nothing
            [(Role.STORED, {"n": 1, "p": 0}), (Role.UPDATE, 1, "p", False)],
            [("a.n", "stored", 1)],
        ),
        (  # what could not be applied: something published is missing, or the server has refused the update
            [
                (Role.UPDATE, 1, "p", "y"),
                (Role.STORED, {"n": 0, "p": {"y": 1}}),
                (Role.STORED, {"n": 1, "p": {"y": 1}}),
            ],
            [("a", "kvs", {"n": 0, "p": {"y": 1}}), ("a.n", "stored", 1)],
        ),
    ],
    ids=["dropped", "stored before", "not applied"],
)
def test_what_is_read_after_a_loss_is_no_stored_change(file, then, told):
    writing = Writing(file)
    writing.put(Role.STATE, {"n": 0, "p": 0}, kind=Kind.READ)
    for role, value, *path in then:
        room = path[-1:] != [False]
        writing.put(role, value, *path[: None if room else -1], kind=KINDS[role], room=room)
    writing.thread.behind.update({"a"} if not room else ())  # the recorder has not taken note yet
    assert [each for each in writing.told() if each[1] != "pub"] == [BEGINNING, *told]


async def test_what_is_published_and_dropped_before_it_is_taken_is_no_stored_change(
    key, akvs, apspace, server_url, binterface, file
):
    """The look that finds it may come before anybody has noticed."""
    await akvs[key()].write({"x": 0, "y": 0, "z": 0})
    async with reem_async.RedisInterface(server_url) as another, recording(binterface, [key()], file) as recorder:
        await aeventually(lambda: is_followed(recorder, key()))
        reading, monitor = recorder._keys.of(key()), recorder._monitor
        waits = reading._reader._limit = asyncio.Semaphore(0)
        recorder._tasks[0].cancel()  # nothing takes updates out but a look that has to know of all
        recorder._catch_up = lambda: None  # and nobody sees that one was dropped
        monitor.queue = BoundedQueue(Last(1))
        await apspace[key()]["x"].write(1)
        await reem_async.PublishSpace(another)[key()]["y"].write(2)
        await aeventually(lambda: monitor.dropped == 1)
        await akvs[key()]["z"].write(3)
        await aeventually(lambda: reading.busy)
        waits.release()
        await aeventually(lambda: not reading.busy)
        del recorder._catch_up
        waits.release()
    told = news(file)
    assert [kind for _, kind, _ in told if kind == "stored"] == []
    assert told[-1] == (key(), "kvs", {"x": 1, "y": 2, "z": 3})


async def test_what_turns_out_at_the_end_not_to_be_written_is_read_once_more(
    key, apspace, binterface, file, monkeypatch
):
    """The writing thread finds that out when the recorder is about to stop."""
    async with Recorder(binterface, [key()], file) as recorder:
        writer, write, released, until = recorder.writer_thread, recorder.writer_thread._write, threading.Event(), []

        def refuse_first(operation):
            assert released.wait(PATIENCE)
            if operation.stamp[0] < until[0]:
                writer._fall_behind(key())
            else:
                write(operation)

        def release():
            until.append(recorder.clock.stamp())
            released.set()

        monkeypatch.setattr(writer, "_write", refuse_first)
        await apspace[key()].write({"n": 1})
        asyncio.get_running_loop().call_later(0.2, release)
    with open_log(file) as log:
        assert log[key()].at(log.end) == {"n": 1}
