"""The sockets of early updates under forks, kill -9, Ctrl-C, full queues, limits, other users and hostile bytes."""

import asyncio
import contextlib
import gc
import os
import resource
import shutil
import signal
import socket
import struct
import subprocess
import sys
import tempfile
import threading

import numpy as np
import pytest
from conftest import PATIENCE, ROOT, aeventually, eventually, line_of
from slotkit import in_slot
from test_local_memory import OPENED

import reem
import reem_async
from reem_async.local import mailbox
from reem_async.local import segment as local_segment
from reem_async.local.mailbox import FOLLOWS, JOINED, PUBLISHER, SUBSCRIBER, UPDATE, Mailbox, Subscribers
from reem_async.local.segment import host, reason_against
from reem_async.plan import notices
from reem_async.plan.keys import keys_of
from reem_async.plan.notices import Slot
from reem_async.pubsub.early import EarlyInbox

pytestmark = pytest.mark.skipif(bool(reason_against()), reason=f"no shared memory: {reason_against()}")


@pytest.fixture
def folder(monkeypatch):
    parent = tempfile.mkdtemp(dir="/tmp")
    monkeypatch.setattr(mailbox, "_PARENT", parent)
    yield f"{parent}/reem-{os.getuid()}"
    shutil.rmtree(parent)


IMAGE = np.arange(30_000, dtype=np.float64)


class Pair:
    """An early publisher and a subscriber, with an interface each, in this event loop."""

    def __init__(self, url, key):
        self.one, self.other = reem_async.RedisInterface(url, local="early"), reem_async.RedisInterface(url)
        self.space, self.number = reem_async.PublishSpace(self.one)[key], 0
        self.channel = keys_of(key).channel.encode()
        self.updates = reem_async.SilentSubscriber(key, self.other).watch(reem_async.Last(1000))

    async def __aenter__(self):
        await self.publish()
        await self.updates.listen()
        assert (await anext(self.updates)).initial
        return self

    async def __aexit__(self, *_):
        await self.one.close()
        await self.other.close()

    async def publish(self, **more):
        self.number += 1
        await self.space.write({"n": self.number, **more})

    async def go_round(self):
        """Publish an update, which arrives once and without a gap; return whether it was early."""
        await self.publish()
        update = await asyncio.wait_for(anext(self.updates), PATIENCE)
        assert (update.data, update.gap, update.missed) == ({"n": self.number}, False, 0)
        return update.early

    async def pass_image(self):
        """Publish an image; return whether it was early, and was looked at in its publisher's memory."""
        image = IMAGE * self.number
        await self.publish(image=image)
        update = await asyncio.wait_for(anext(self.updates), PATIENCE)
        assert np.array_equal(update.data["image"], image)
        return update.early, in_slot(update.data["image"])

    @property
    def mailboxes(self):
        return self.one.session.local.subscribers._mailbox, self.other.session.subscriptions._inbox.early._mailbox


def descriptors():
    return len(os.listdir("/proc/self/fd"))


def child(work):
    pid = os.fork()
    if pid == 0:
        with contextlib.suppress(BaseException):
            os._exit(0 if work() else 1)
        os._exit(2)
    return os.waitstatus_to_exitcode(os.waitpid(pid, 0)[1])


async def test_mailboxes_need_no_thread_and_go_with_their_interfaces(server_url, key, folder):
    threads, before = threading.active_count(), descriptors()
    async with Pair(server_url, key("cam")) as pair:
        assert await pair.go_round()
        assert len(os.listdir(folder)) == 2
        assert threading.active_count() == threads
    assert not os.listdir(folder)
    assert descriptors() <= before


def test_each_event_loop_of_a_process_has_a_mailbox(server_url, key, folder):
    """Interfaces of the asyncio front go from loop to loop; the blocking front has a loop of its own beside them."""

    async def turn():
        async with Pair(server_url, key("cam")) as pair:
            assert await pair.go_round()
            assert await pair.go_round()

    seen = []
    with reem.RedisInterface(server_url, local="early") as one, reem.RedisInterface(server_url) as other:
        space = reem.PublishSpace(one)
        reem.CallbackSubscriber(key("arm"), other, lambda data, path: seen.append(data), {}).listen()
        for number in range(3):
            asyncio.run(turn())
            space[key("arm")] = {"n": number}
            eventually(lambda number=number: {"n": number} in seen)
    assert seen == [{"n": 0}, {"n": 1}, {"n": 2}]
    assert not os.listdir(folder)


async def test_who_follows_without_an_early_publisher_has_no_mailbox(server_url, key, folder):
    async with reem_async.RedisInterface(server_url) as interface:
        await reem_async.PublishSpace(interface)[key("cam")].write({"n": 1})
        async with reem_async.SilentSubscriber(key("cam"), interface):
            assert interface.session.subscriptions._inbox.early._mailbox is None
    assert not os.path.exists(folder)


async def test_a_forked_child_neither_reads_nor_removes_what_is_its_parents(server_url, key, folder):
    async with Pair(server_url, key("cam")) as pair:
        assert await pair.go_round()
        publisher, subscriber = pair.mailboxes
        subscriber.send(publisher.address, JOINED, b"channel")
        numbers = [each.descriptor for each in pair.mailboxes]

        def has_none():
            closed = not any(os.path.exists(f"/proc/self/fd/{number}") for number in numbers)
            return closed and publisher.receive() is None and pair.one.session.local.subscribers.ask(pair.channel)

        assert child(has_none) == 0
        assert len(os.listdir(folder)) == 2 + 1  # that of the child, which ended without closing it
        assert pair.one.session.local.subscribers.take_answers() == [b"channel"]
        assert await pair.go_round()
        Mailbox(PUBLISHER).close()
        assert len(os.listdir(folder)) == 2


PROGRAM = """
import collections, sys, threading, time
import reem
from reem_async.local import mailbox

def follow():
    for update in updates:
        early.append(update.early)

mailbox._PARENT, url, key = sys.argv[1:4]
space = reem.PublishSpace(reem.RedisInterface(url, local="early"))[key]
updates = reem.SilentSubscriber(key, reem.RedisInterface(url)).watch(reem.Every(1000))
updates.listen()
number, early = 0, collections.deque(maxlen=3)
threading.Thread(target=follow, daemon=True).start()
while True:
    try:
        while sum(early) < 3:
            space.write({"program": (number := number + 1)})
            time.sleep(0.001)
        print("early", flush=True)
        early.clear()
        while True:
            space.write({"program": (number := number + 1)})
    except KeyboardInterrupt:
        pass
"""


@contextlib.contextmanager
def program(folder, *words):
    command = [sys.executable, "-c", PROGRAM, os.path.dirname(folder), *words]
    with subprocess.Popen(command, stdout=subprocess.PIPE, cwd=ROOT) as process:
        try:
            assert line_of(process.stdout.fileno()).strip() == "early"
            yield process
        finally:
            process.kill()


async def test_killed_programs_leave_nothing_once_another_one_has_begun(server_url, key, folder):
    """A publisher goes on beside their sockets, and what they leave in the folder is removed."""
    before = descriptors()
    async with Pair(server_url, key("cam")) as pair:
        for _ in range(2):
            with program(folder, server_url, key("cam")) as process:
                assert len(os.listdir(folder)) >= 3
                await pair.publish()
                process.kill()
                process.wait()
            assert len(os.listdir(folder)) > 2
            Mailbox(SUBSCRIBER).close()
            assert len(os.listdir(folder)) == 2
            await pair.publish()
        follower = pair.updates._link.follower
        await aeventually(lambda: follower.value() == {"n": pair.number} and not follower._replica._early)
    await aeventually(lambda: descriptors() <= before)
    async with Pair(server_url, key("cam")) as pair:
        assert await pair.go_round()


def test_ctrl_c_at_any_instant_leaves_a_program_that_is_notified_early(server_url, key, folder):
    with program(folder, server_url, key("cam")) as process:
        for _ in range(5):
            process.send_signal(signal.SIGINT)
            assert line_of(process.stdout.fileno()).strip() == "early"
        assert len(os.listdir(folder)) == 2


async def test_after_the_folder_was_removed_updates_are_early_again(server_url, key, folder):
    """As by a program that empties /tmp."""
    async with Pair(server_url, key("cam")) as pair:
        for _ in range(2):
            assert await pair.go_round()
            shutil.rmtree(folder)
            assert not await pair.go_round()
            pair.one.session.local._audiences.clear()  # so that the publisher asks now, not within a second
            await pair.go_round()
        assert len(os.listdir(folder)) == 2


async def test_all_subscribers_of_a_key_are_notified_early_though_a_queue_has_room_for_few_answers(folder):
    """A publisher's queue often has room for 10 of them."""
    publisher, inboxes = Subscribers(), [EarlyInbox(lambda *_: None) for _ in range(30)]
    address = publisher.ask(b"channel")
    for inbox in inboxes:
        inbox.answer(b"channel", address)
    publisher.take_answers()
    assert publisher.count(b"channel") < len(inboxes)
    async with asyncio.timeout(PATIENCE):
        while publisher.count(b"channel") < len(inboxes):
            await asyncio.sleep(0.01)
            publisher.take_answers()
    for each in (publisher, *inboxes):
        each.close()
    assert not os.listdir(folder)


async def test_a_program_that_is_stopped_costs_nothing_but_its_own_early_updates(server_url, key, folder):
    async with Pair(server_url, key("cam")) as pair:
        assert await pair.go_round()
        stopped = Mailbox(SUBSCRIBER)
        stopped.send(pair.mailboxes[0].address, FOLLOWS, pair.channel, stopped.address.encode())
        for _ in range(100):
            assert await pair.go_round()
        read = 0
        while stopped.receive() is not None:
            read += 1
        assert 0 < read < 100, "its queue was full"
        stopped.close()


async def test_the_memory_of_an_early_publisher_arrives_with_its_updates(server_url, key, folder, monkeypatch):
    """Where `/proc` does not show it. What was lost arrives with the next answer, within a second."""

    def hidden(_):
        raise PermissionError

    before = descriptors()
    async with Pair(server_url, key("cam")) as pair:
        monkeypatch.setattr(local_segment, "_opened", hidden)
        assert await pair.go_round()
        assert await pair.pass_image() == (True, True)
        pair.other.session.local.close()  # what it has looked at is unmapped
        pair.other.session.local._off = False
        assert (await pair.pass_image())[1] is False
        pair.one.session.local._audiences.clear()
        await pair.pass_image()
        kept = [await pair.pass_image() for _ in range(3)]
        assert kept[-1] == (True, True), kept
    del pair  # has the last image
    gc.collect()
    assert descriptors() <= before


CONTAINED = """
import os, sys
import reem
from reem_async.local import mailbox
from slotkit import in_slot

mailbox._PARENT, url, key = sys.argv[1:4]
with reem.SilentSubscriber(key, reem.RedisInterface(url)).watch(reem.Last(1000)) as updates:
    print("ready", os.getpid(), flush=True)
    for update in updates:
        if update.early:
            print(in_slot(update.data["image"]), flush=True)
"""


@pytest.mark.skipif(
    subprocess.run(["unshare", "--pid", "--fork", "--mount-proc", "true"], capture_output=True, check=False).returncode
    != 0,
    reason="processes cannot have numbers of their own here",
)
async def test_a_container_that_shares_the_folder_is_notified_early_and_looks_into_the_memory(server_url, key, folder):
    async with Pair(server_url, key("cam")) as pair:
        command = ["unshare", "--pid", "--fork", "--mount-proc", "--kill-child", sys.executable, "-c", CONTAINED]
        words = os.path.dirname(folder), server_url, key("cam")
        with subprocess.Popen(
            [*command, *words], stdout=subprocess.PIPE, cwd=ROOT, env={**os.environ, "PYTHONPATH": f"{ROOT}/tests"}
        ) as process:
            assert line_of(process.stdout.fileno()).split() == ["ready", "1"]
            reported = asyncio.create_task(asyncio.to_thread(line_of, process.stdout.fileno()))
            while not reported.done():
                await pair.pass_image()
            process.kill()
        assert reported.result().strip() == "True"


async def test_without_a_descriptor_updates_arrive_through_the_server(server_url, key, folder):
    limits = resource.getrlimit(resource.RLIMIT_NOFILE)
    async with Pair(server_url, key("cam")) as pair:
        for each in pair.mailboxes:
            each.close()
        pair.other.session.subscriptions._inbox.early.close()
        pair.one.session.local._audiences.clear()
        resource.setrlimit(resource.RLIMIT_NOFILE, (3, limits[1]))
        try:
            assert not await pair.go_round()
        finally:
            resource.setrlimit(resource.RLIMIT_NOFILE, limits)
        pair.one.session.local._audiences.clear()
        await pair.go_round()
        assert await pair.go_round()


async def test_programs_that_cannot_meet_get_updates_through_the_server(server_url, key, folder, monkeypatch, caplog):
    """As on both sides of a container's boundary, or if another user can enter the folder."""
    os.mkdir(folder)
    async with Pair(server_url, key("cam")) as pair:
        os.chmod(folder, 0o755)
        assert not await pair.go_round()
        assert not await pair.go_round()
        assert caplog.text.count(f"run: chmod 700 {folder}") == 1
        os.chmod(folder, 0o700)
    pair = Pair(server_url, key("arm"))
    await pair.publish()
    os.mkdir(f"{folder}/elsewhere")
    monkeypatch.setattr(mailbox, "_PARENT", f"{folder}/elsewhere")
    async with pair:
        pair.one.session.local._audiences.clear()  # so that the publisher asks now, not within a second
        assert not await pair.go_round()
        assert not await pair.go_round()
        assert all(each.close.alive for each in pair.mailboxes)


@pytest.mark.skipif(os.geteuid() != 0, reason="only root can be somebody else")
def test_datagrams_of_another_user_are_not_read(folder):
    mine = Mailbox(SUBSCRIBER)
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as theirs:
        theirs.connect(f"{folder}/{mine.address}")

        def send():
            os.setuid(65534)
            return theirs.send(b"U\0\1anotice")

        assert child(send) == 0
    Mailbox(PUBLISHER).send(mine.address, UPDATE, b"a", b"mine")
    assert mine.receive().content == b"mine"
    assert mine.receive() is None
    mine.close()


def hostile(channel):
    notice = b'[1,"evil",2,1.0,[],"set",5,[]]\n[{}]x'
    return {
        "nothing": b"",
        "one byte": b"U",
        "no channel": b"U\xff\xffx",
        "another kind": b"\0" + struct.pack("!H", len(channel)) + channel,
        "an unknown channel": b"U\0\3abc" + notice,
        "no notice": b"U" + struct.pack("!H", len(channel)) + channel + b"\xff" * 100,
        "parts that are missing": b"U" + struct.pack("!H", len(channel)) + channel + notice,
        "too large": b"U" + struct.pack("!H", len(channel)) + channel + b"[" * (1 << 17),
        "an address elsewhere": b"F" + struct.pack("!H", len(channel)) + channel + b"../../../run/systemd/notify",
        "an address that does not exist": b"F"
        + struct.pack("!H", len(channel))
        + channel
        + f"{host()}s{'0' * 16}".encode(),
        "an unknown channel to notify": b"F\0\3abc" + f"{host()}s{'0' * 16}".encode(),
        "a text that is none": b"F" + struct.pack("!H", len(channel)) + channel + b"\xff" * 33,
    }


async def test_hostile_datagrams_change_nothing(server_url, key, folder):
    """Their descriptors are closed, too."""
    async with Pair(server_url, key("cam")) as pair:
        assert await pair.go_round()
        before = descriptors()
        with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as sender, open("/dev/null", "rb") as file:
            for each in pair.mailboxes:
                sender.connect(f"{folder}/{each.address}")
                for number, content in enumerate(hostile(pair.channel).values()):
                    with contextlib.suppress(BlockingIOError):
                        socket.send_fds(sender, [content], [file.fileno()] * number, socket.MSG_DONTWAIT)
                    assert await pair.go_round()
        await aeventually(lambda: descriptors() == before)
        assert pair.one.session.local.subscribers._known.keys() == {pair.channel}
        for _ in range(3):
            assert await pair.go_round()


async def test_forged_descriptors_are_closed(server_url, key, folder, tmp_path, monkeypatch):
    """Each is named as the memory of an update, alone or twenty times over. Segments are mapped for a while."""
    monkeypatch.setattr(local_segment, "_IDLE", 0.0)
    async with Pair(server_url, key("cam")) as pair:
        assert await pair.pass_image() == (True, True)
        address, follower = pair.mailboxes[1].address, pair.updates._link.follower
        head = struct.pack("!cH", UPDATE, len(pair.channel)) + pair.channel
        forged = [make(tmp_path) for make in OPENED.values()]
        before = descriptors()
        with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as sender:
            sender.connect(f"{folder}/{address}")
            for number in range(1000):
                descriptor = forged[number % len(forged)]
                slot = Slot(host(), os.getpid(), 10**6, os.fstat(descriptor).st_ino, 0, 7)
                notice = notices.in_slot(f"evil{number}", 1, 1.0, (), slot, b"1", [])
                numbers = [descriptor] * (20 if number % 3 == 2 else 1)
                socket.send_fds(sender, [head + notice], numbers, socket.MSG_DONTWAIT)
                await asyncio.sleep(0.001 if number % 5 == 4 else 0)  # the queue has room for 10
        await aeventually(lambda: descriptors() <= before)
        for descriptor in forged:
            os.close(descriptor)
        assert follower.value()["n"] == pair.number
        pair.one.session.local._audiences.clear()  # so that the publisher asks now, not within a second
        await pair.pass_image()
        assert await pair.pass_image() == (True, True)
