"""Services: a call is handled once or not at all, gets its own answer or an error that is true, and leaves nothing."""

import asyncio
import collections
import contextlib
import os
import pickle
import random
import signal
import threading
import time
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import numpy as np
import orjson
import pytest
from chaos.proxy import Proxy
from conftest import (
    PATIENCE,
    aeventually,
    assert_same,
    commands_run,
    eventually,
    keys_of,
    python,
    server_without_right,
    sized,
)
from own_servers import free_port
from servicekit import LARGE, act, program

import reem
import reem_async
from reem_async.coordination import messages
from reem_async.errors import (
    BadData,
    BadType,
    BadValue,
    Busy,
    CallTimeout,
    ConnectionLost,
    NoService,
    NotAllowed,
    NotConnected,
    RemoteError,
    ServiceError,
    ServiceLost,
    WrongLoop,
)
from reem_async.local.mailbox import Mailbox
from reem_async.plan.changes import EncodedAttachment
from reem_async.server import EmbeddedServer

VALUES = {
    "nothing": None,
    "plain": {"a": [1, 2.5, "x", None, True], "$ship ": "$ship text", "f": 0.1 + 0.2},
    "arrays": {"image": np.arange(12, dtype=np.uint8).reshape(3, 4), "list": [np.ones(2, bool), b"bytes"]},
    "an array": np.linspace(0, 1, 7),
    "a large array": np.random.default_rng(1).random(LARGE),
    "large arrays": {"left": np.zeros((480, 640, 3), np.uint8), "right": [np.ones(LARGE, ">f4")], "b": b"x" * 200_000},
    "a long text": {"text": "ü" * 100_000, "image": np.arange(5)},
    "a long list": [0.1 * n for n in range(20_000)],
}


def served(front, place, function, **options):
    async def begin():
        service = place.serve(function, **options)
        await service.listen()
        return service

    return place.serve(function, **options) if isinstance(front.interface, reem.RedisInterface) else front.run(begin())


@pytest.mark.parametrize("kind", VALUES)
def test_arguments_and_answers_are_what_reem_stores(front, raw, key, kind):
    """Bit by bit, as after a write and a read, and nothing of them stays on the server."""
    place = front.kvs[key()]["deep"]["place"]
    got = []

    def act(value):
        got.append(value)
        return value

    service = served(front, place, act)
    expected = VALUES[kind]
    for number in range(3):  # the first goes through the server, large ones from then on through shared memory
        answer = front.wait(place.call(value=expected, timeout=PATIENCE))
        assert_same(got[number], expected)
        assert_same(answer, expected)
    assert keys_of(raw, key()) == set()
    assert service("called here") == "called here"
    front.wait(service.close())


@pytest.mark.parametrize("fails", ["nothing", "requests", "answers"])
async def test_large_values_go_through_shared_memory_on_one_host(akvs, binterface, raw, key, monkeypatch, fails):
    """And through the server where the memory cannot be read, or too many answers are in it; each is the right one."""
    other = reem_async.KeyValueStore(binterface)
    if fails != "nothing":
        reader = akvs if fails == "requests" else other
        monkeypatch.setattr(reader.interface.session.local, "view", lambda slot, size: None)

    async def act(array, nap):
        await asyncio.sleep(nap)
        return array + 1

    async with akvs[key()].serve(act, concurrency=10):
        place = other[key()]
        await place.call(array=np.zeros(LARGE), nap=0)
        for nap in (0, 0.01, 0.1):
            arrays = [np.full(LARGE + n, float(n)) for n in range(20)]
            answers = await asyncio.gather(*(place.call(array=each, nap=nap, timeout=PATIENCE) for each in arrays))
            assert all((answer == each + 1).all() for answer, each in zip(answers, arrays, strict=True))
            answers = [await place.call(array=each, nap=0, timeout=PATIENCE) for each in arrays]
            assert all((answer == each + 1).all() for answer, each in zip(answers, arrays, strict=True))
        before = commands_run(raw).get("set", 0)
        del answers
        await place.call(array=np.zeros(LARGE), nap=0)
        sent = commands_run(raw).get("set", 0) - before
        assert sent == {"nothing": 0, "requests": 1, "answers": 1}[fails]
    await aeventually(lambda: keys_of(raw, key()) == set())


class Untold(Exception):
    def __str__(self):
        raise SystemExit


def test_what_a_function_raises_reaches_the_caller(front, key):
    """With type, text and traceback; so does a result that cannot be stored, with its path."""
    place = front.kvs[key()]

    def act(number):
        if number == 1:
            raise KeyError("odd\ud800")
        if number == 3:
            raise SystemExit(5)
        if number == 5:
            raise Untold
        return {"a": [{1, 2}]} if number == 2 else number

    served(front, place, act)
    for arguments, words in (
        ({"number": 1}, "KeyError: 'odd"),
        ({"number": 2}, rf"BadType: {key()}\.a\[0\]: "),
        ({"number": 3}, "SystemExit: 5"),
        ({"number": 5}, r"Untold: \(its text cannot be shown\)"),
        ({"nomber": 2}, "TypeError: .*nomber"),
    ):
        with pytest.raises(RemoteError, match=words) as caught:
            front.wait(place.call(**arguments))
        assert words.startswith(caught.value.type_name)
        assert ('raise KeyError("odd' in caught.value.traceback) == (arguments == {"number": 1})
        assert "coordination" not in caught.value.traceback
        assert caught.value.traceback.strip() in caught.value.__notes__[0]
        copy = pickle.loads(pickle.dumps(caught.value))
        assert (str(copy), copy.traceback) == (str(caught.value), caught.value.traceback)
    assert front.wait(place.call(number=4)) == 4


def test_bad_input_is_refused_before_anything_is_sent(front, key):
    place = front.kvs[key()]
    for timeout in (0, -1, float("nan"), "1", True):
        with pytest.raises((BadValue, BadType), match="timeout"):
            front.wait(place.call(timeout=timeout))
    with pytest.raises(BadType, match=rf"{key()}\.x: "):
        front.wait(place.call(x={1}))
    for wrong in ({"concurrency": 0}, {"queue": 0}, {"queue": 1.5}):
        with pytest.raises((BadValue, BadType), match=next(iter(wrong))):
            served(front, place, act, **wrong)
    with pytest.raises(BadType, match="give serve"):
        served(front, place, 5)
    with pytest.raises(BadValue, match="500 arrays, or other values of ships, are too many"):
        front.wait(place.call(**{f"{'x' * 300}{number}": np.zeros(1) for number in range(500)}))
    with pytest.raises(NoService, match="no program serves"):
        front.wait(place.call())


def test_serving_needs_a_running_loop_or_a_plain_function(server_url, kvs, key):
    with pytest.raises(WrongLoop, match="running event loop"):
        reem_async.KeyValueStore(server_url)[key()].serve(act)
    with pytest.raises(BadType, match="reem_async"):
        kvs[key()].serve(asyncio.sleep)


async def test_no_call_goes_to_a_service_that_is_closing_or_closed(server, key):
    """Its connection is slow, that of the caller is not: a request may be on its way when the service closes."""
    with Proxy(server.port) as proxy:
        async with reem_async.RedisInterface(proxy.url) as far, reem_async.RedisInterface(server) as near:
            place = reem_async.KeyValueStore(near)[key()]
            async with reem_async.KeyValueStore(far)[key()].serve(act) as service:
                assert (await place.call(number=1))["number"] == 1
                proxy.delay = 0.05
                closing = asyncio.create_task(service.close())
                await asyncio.sleep(0)
                with pytest.raises(NoService):
                    await place.call(number=2)
                await closing
                assert not await near.client.pubsub_channels("*:serve@*")


def test_functions_of_one_name_share_the_calls_and_a_function_may_call(kvs, server_url, key):
    """Also one that is served twice in a program; a function that blocks in REEM blocks no other."""
    names = []

    def outer(name):
        names.append(threading.current_thread().name)
        kvs[key("bar")] = name
        return kvs[key("inner")].call(name=name), kvs[key("bar")].read() is not None

    def inner(name):
        time.sleep(0.05)
        return name, threading.get_ident()

    with kvs[key()].serve(outer, concurrency=4), kvs[key("inner")].serve(inner), kvs[key("inner")].serve(inner):
        answers = []
        callers = [threading.Thread(target=lambda n=n: answers.append(kvs[key()].call(name=n))) for n in range(8)]
        for each in callers:
            each.start()
        for each in callers:
            each.join()
        assert sorted(name for (name, _), _ in answers) == list(range(8))
        assert len({thread for (_, thread), _ in answers}) == 2
        assert all(was_read for _, was_read in answers)
    with pytest.raises(NoService):
        kvs[key()].call(name=1)


def test_the_node_says_what_it_serves(server_url, key):
    with reem.RedisInterface(server_url, name=key("node")) as interface:
        place = reem.KeyValueStore(interface)[key()]["act"]

        def served():
            return [node.serves for node in interface.nodes() if node.name == key("node")]

        with place.serve(act), place.serve(act):
            eventually(lambda: served() == [(f"{key()}.act",)])
        eventually(lambda: served() == [()])


async def test_a_call_that_is_left_cancels_its_function(akvs, raw, key):
    """By cancelling the task, and by the timeout. What waits is never begun then, though its values are there."""
    begun, cancelled, go_on = [], [], asyncio.Event()

    @akvs[key()].serve
    async def act(number, array):
        begun.append(number)
        try:
            await go_on.wait()
        except asyncio.CancelledError:
            cancelled.append(number)
            raise
        return number

    await act.listen()
    array = np.zeros(LARGE)
    calls = [asyncio.create_task(akvs[key()].call(number=n, array=array, timeout=20)) for n in range(2)]
    await aeventually(lambda: begun == [0])
    calls[1].cancel()
    await asyncio.sleep(0.05)
    calls[0].cancel()
    await aeventually(lambda: cancelled == [0])
    with pytest.raises(CallTimeout, match="may or may not") as caught:
        await akvs[key()].call(number=2, array=array, timeout=0.2)
    assert isinstance(caught.value, TimeoutError)
    await aeventually(lambda: cancelled == [0, 2])
    go_on.set()
    assert await akvs[key()].call(number=3, array=array) == 3
    assert begun == [0, 2, 3]
    await aeventually(lambda: keys_of(raw, key()) == set())


@pytest.fixture
async def early(server_url):
    async with reem_async.RedisInterface(server_url, local="early") as interface:
        yield reem_async.KeyValueStore(interface)


async def test_on_one_host_calls_need_no_server_in_between(akvs, early, raw, key):
    """From the second call on: requests, answers, what is refused, and the word that a caller has left."""
    cancelled = []

    async def act(number, array=None):
        try:
            await asyncio.sleep(PATIENCE if number < 0 else 0)
        except asyncio.CancelledError:
            cancelled.append(number)
            raise
        return {"number": 1 / number, "array": array}

    place, array = early[key()], np.arange(LARGE)
    service = akvs[key()].serve(act, concurrency=2, queue=1)
    await service.listen()
    await place.call(number=1)
    before = commands_run(raw)
    for number in range(1, 50):
        answer = await place.call(number=number, array=array if number % 5 == 0 else None)
        assert answer["number"] == 1 / number
    with pytest.raises(RemoteError, match="ZeroDivisionError"):
        await place.call(number=0)
    calls = [asyncio.create_task(place.call(number=-n)) for n in (1, 2, 3)]
    await asyncio.sleep(0.05)
    for call in calls:
        call.cancel()
    await aeventually(lambda: {*cancelled} >= {-1, -2})
    assert (await place.call(number=4))["number"] == 0.25
    after = commands_run(raw)
    sent = sum(after.get(name, 0) - before.get(name, 0) for name in ("publish", "spublish", "set"))
    assert sent <= 6  # pings
    await service.close()
    with pytest.raises(NoService):
        await place.call(number=5)


@pytest.mark.parametrize("fails", ["sends", "opens"])
async def test_calls_go_through_the_server_where_the_direct_path_fails(akvs, early, key, monkeypatch, fails):
    """Each is answered, and none twice."""
    chance, got = random.Random(1), []
    sends = Mailbox.try_send

    def send(self, *words):
        if chance.random() < 0.5:
            raise BlockingIOError
        sends(self, *words)

    def refuse(self, role):
        raise OSError

    monkeypatch.setattr(Mailbox, *("try_send", send) if fails == "sends" else ("__init__", refuse))
    async with akvs[key()].serve(lambda number: got.append(number), concurrency=4):
        await asyncio.gather(*(early[key()].call(number=n) for n in range(50)))
        for number in range(50, 100):
            await early[key()].call(number=number)
    assert sorted(got) == list(range(100))


async def test_a_full_queue_is_busy_and_another_server_helps(akvs, binterface, key):
    running, most, go_on = 0, 0, asyncio.Event()

    async def act():
        nonlocal running, most
        running += 1
        most = max(most, running)
        await go_on.wait()
        running -= 1

    async with akvs[key()].serve(act, concurrency=2, queue=3):
        calls = [asyncio.create_task(akvs[key()].call()) for _ in range(5)]
        await aeventually(lambda: running == 2)
        await asyncio.sleep(0.05)
        with pytest.raises(Busy, match="1 servers"):
            await akvs[key()].call()
        async with reem_async.KeyValueStore(binterface)[key()].serve(lambda: "helped"):
            await asyncio.sleep(1.1)  # callers ask each second which servers there are
            answers = [await akvs[key()].call() for _ in range(5)]
            assert "helped" in answers
        go_on.set()
        assert await asyncio.gather(*calls) == [None] * 5
        assert most == 2


async def test_a_thousand_calls_wait(akvs, raw, key):
    async def act(number):
        await asyncio.sleep(0.001)
        return number

    async with akvs[key()].serve(act, concurrency=100, queue=1000):
        answers = await asyncio.gather(*(akvs[key()].call(number=n, timeout=PATIENCE) for n in range(1000)))
    assert answers == list(range(1000))
    assert keys_of(raw, key()) == set()


async def test_closing_sends_waiting_calls_elsewhere(akvs, binterface, key):
    """What was begun is lost, and says so."""
    begun = asyncio.Event()

    async def slow():
        begun.set()
        await asyncio.sleep(PATIENCE)

    service = akvs[key()].serve(slow)
    await service.listen()
    calls = [asyncio.create_task(akvs[key()].call()) for _ in range(3)]
    await begun.wait()
    async with reem_async.KeyValueStore(binterface)[key()].serve(lambda: "here"):
        await service.close()
        outcomes = await asyncio.gather(*calls, return_exceptions=True)
    assert [type(outcome) for outcome in outcomes].count(ServiceLost) == 1
    assert outcomes.count("here") == 2


@pytest.mark.parametrize("turns", range(6))
async def test_a_service_that_is_closed_while_it_begins_does_not_serve(akvs, key, turns):
    service = akvs[key()].serve(lambda: 1)
    waiting = asyncio.create_task(service.wait())
    for _ in range(turns):
        await asyncio.sleep(0)
    assert not waiting.done()
    await service.close()
    await asyncio.wait_for(waiting, PATIENCE)
    with pytest.raises(NoService):
        await akvs[key()].call()


@pytest.fixture(params=["auto", "early"])
def caller(request, server_url):
    with reem.RedisInterface(server_url, local=request.param) as interface:
        yield reem.KeyValueStore(interface)


def test_a_killed_server_is_noticed(caller, raw, server_url, key):
    """Within 0.3 s and a look, the call is not repeated, and the next one goes to another server."""
    with program("serve", server_url, key()) as process:
        assert caller[key()].call(number=3)["pid"] == process.pid
        began = time.monotonic()
        threading.Timer(0.2, process.kill).start()
        with pytest.raises(ServiceLost, match="may or may not"):
            caller[key()].call(number=4, nap=20, array=np.zeros(LARGE))
        assert time.monotonic() - began < 1.2
    with pytest.raises(NoService):
        caller[key()].call(number=5)
    with caller[key()].serve(act):
        assert caller[key()].call(number=6)["pid"] == os.getpid()
    eventually(lambda: keys_of(raw, key()) == set())


def test_a_stopped_server_is_noticed_and_begins_nothing_later(caller, server_url, key, tmp_path):
    with program("serve", server_url, key()) as process:
        caller[key()].call(number=3)
        process.send_signal(signal.SIGSTOP)
        eventually(lambda: Path(f"/proc/{process.pid}/stat").read_text().rpartition(")")[2].split()[0] == "T")

        def leave(number):  # so much that the word that a caller has left comes much later than its request
            with pytest.raises(CallTimeout):
                caller[key()].call(number=number, timeout=0.3, array=np.zeros(8000), done=str(tmp_path / "done"))

        with ThreadPoolExecutor() as pool:
            assert len(list(pool.map(leave, [4] * 6))) == 6
        began = time.monotonic()
        with pytest.raises(ServiceLost, match=r"0\.9 s"):
            caller[key()].call(number=5, done=str(tmp_path / "done"))
        assert time.monotonic() - began < sized(4, 2)
        time.sleep(0.1)  # a program says in the background that it has left
        process.send_signal(signal.SIGCONT)
        eventually(lambda: answers(caller[key()]))
        assert not (tmp_path / "done").exists()


def answers(place):
    try:
        return place.call(number=6, timeout=1)["number"] == 6
    except (ServiceError, ConnectionLost, NotConnected):
        return False


async def test_a_killed_caller_leaves_nothing(akvs, raw, server_url, key):
    """Its function is cancelled at the deadline that came with the request; values that nothing fetches expire."""
    cancelled, begun = asyncio.Event(), asyncio.Event()

    @akvs[key()].serve
    async def act(number, array):
        begun.set()
        try:
            await asyncio.sleep(PATIENCE)
        except asyncio.CancelledError:
            cancelled.set()
            raise

    await act.listen()
    with program("call", server_url, key(), 1, 1.5):
        await asyncio.wait_for(begun.wait(), PATIENCE)
    await asyncio.wait_for(cancelled.wait(), PATIENCE)
    assert keys_of(raw, key()) == set()


def test_ctrl_c_ends_a_call_and_its_function_is_not_waited_for(server_url, key):
    """A program that calls, and one that serves, end at once."""
    code = """
        import os, signal, sys, threading, time, reem
        place = reem.KeyValueStore(sys.argv[1])[sys.argv[2]]
        service = place.serve(lambda: time.sleep(30))
        threading.Timer(0.3, os.kill, (os.getpid(), signal.SIGINT)).start()
        began = time.monotonic()
        for wait in (place.call, service.wait):
            try:
                wait()
            except KeyboardInterrupt:
                print(time.monotonic() - began < 5)
            threading.Timer(0.3, os.kill, (os.getpid(), signal.SIGINT)).start()
        """
    done = python(code, server_url, key())
    assert (done.stdout, done.returncode) == ("True\nTrue\n", 0) or "KeyboardInterrupt" in done.stderr, done.stderr


def test_a_forked_child_calls_and_does_not_serve(kvs, server_url, key):
    kvs[key()].serve(act)
    kvs[key()].call(number=1)
    child = os.fork()
    if not child:
        try:
            status = 0 if kvs[key()].call(number=2, timeout=10)["pid"] == os.getppid() else 1
        except BaseException:
            status = 2
        os._exit(status)
    assert os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]) == 0
    assert kvs[key()].call(number=3)["pid"] == os.getpid()


@pytest.mark.parametrize("way", ["stopped", "killed"])
def test_services_go_on_after_a_restart_of_the_server(key, tmp_path, way):
    """A call that was under way gets an error, and later ones are answered."""
    server = EmbeddedServer(free_port(), tmp_path if way == "killed" else None)
    with server, contextlib.closing(reem.RedisInterface(server.url)) as interface:
        place = reem.KeyValueStore(interface)[key()]
        place.serve(act, concurrency=2)
        place.call(number=1)
        outcome = []

        def call():
            with contextlib.suppress(ConnectionLost, ServiceLost, NotConnected):
                outcome.append(place.call(number=2, nap=1.0))

        caller = threading.Thread(target=call)
        caller.start()
        time.sleep(0.2)
        if way == "killed":
            os.kill(server.pid, signal.SIGKILL)
            eventually(lambda: not server.running)
        server.stop()
        server.start()
        caller.join(PATIENCE)
        assert outcome == []
        eventually(lambda: answers(place))


@pytest.mark.parametrize("right", ["publish", "subscribe", "pubsub|channels"])
async def test_a_missing_right_is_named(key, right):
    async with server_without_right(right) as (kvs, address), reem_async.RedisInterface(address) as robot:
        place = reem_async.KeyValueStore(robot)[key()]
        if right == "subscribe":
            with pytest.raises(NotAllowed, match=r"\+subscribe"):
                await place.serve(act).listen()
        await kvs[key()].serve(lambda: 1).listen()
        with pytest.raises(NotAllowed, match=right.replace("|", r"\|")):
            await place.call(timeout=5)


def test_a_large_value_expires_from_the_moment_it_is_stored():
    """Also one that its sender does not live to announce: no plain SET, which may be staged for a minute."""
    value = b"x" * 100_000, [EncodedAttachment(".a", "numpy", (("SET", "p.a", bytes(100_000)),), (bytes(100_000),))]
    message = messages.Message(messages.CALL, "a" * 16, "b" * 16, 1.0, ["", ""])
    commands = messages.packed(message, value, "p", 1.0, None).commands
    assert [(command[1], command[3:]) for command in commands] == [("p.a", ("PX", "6000")), ("p:text", ("PX", "6000"))]


def mutations(payload, seed):
    """Messages that REEM does not write, made from one that it does."""
    chance = random.Random(seed)
    head, _, rest = payload.partition(b"\n")
    for _ in range(sized(150, 1500)):
        fields = orjson.loads(head)
        odd = [None, -1, 1e400, "", "x" * 300_000, [], {}, "../..", "0" * 16, 2**60, [[]], ["numpy", "oops", 5], True]
        fields[chance.randrange(len(fields))] = chance.choice(odd)
        with contextlib.suppress(TypeError):
            yield orjson.dumps(fields) + b"\n" + rest
        cut = bytearray(payload)
        cut[chance.randrange(len(cut))] = chance.randrange(256)
        yield bytes(cut[: chance.randrange(len(cut) + 1)])


async def test_hostile_messages_are_refused(akvs, raw, key):
    """On the channels of the server and of the caller: nothing is handled, answered or removed because of them."""
    calls = []
    release = asyncio.Event()

    @akvs[key()].serve
    async def act(number):
        calls.append(number)
        await release.wait()
        return {"number": number, "a": np.arange(3)}

    await act.listen()
    await akvs[key()].write({"a": np.arange(3)})
    call = asyncio.create_task(akvs[key()].call(number=1, timeout=60))
    await aeventually(lambda: calls == [1])
    manager = akvs.interface.session.subscriptions
    served = next(each for each in manager.kept.values() if hasattr(each, "closed"))
    caller = next(each for each in manager.kept.values() if hasattr(each, "_pending"))
    (pending,) = caller._pending
    value = b'{"number":2}', ()
    call_id = messages.Message(messages.CALL, "a" * 16, "b" * 16, 5, ["", ""])
    request = messages.packed(call_id, value, "", 5, None).payload
    answer = messages.packed(call_id._replace(kind=messages.ANSWER, call=pending), value, "", 5, None).payload
    odd = b"{}", [EncodedAttachment("x", "numpy", (), (b"",))]  # an attachment under the key of something else
    with pytest.raises(BadData, match="a value that cannot be"):
        messages.decode(messages.packed(call_id, odd, "", 5, None).payload, lambda *_: None)
    for seed, (listener, payload) in enumerate([(served, request), (caller, answer)]):
        for odd in (answer if listener is caller else b"", *mutations(payload, seed)):
            with contextlib.suppress(BadData):
                message = messages.decode(odd, lambda *_: None)
                if message.kind == messages.CALL and message.number > 0:
                    continue  # a sound request of a program that nothing is known of
            with contextlib.suppress(BadData):
                listener.on_message(odd)
    await asyncio.sleep(0.1)
    assert not call.done()
    release.set()
    assert (await call)["number"] == 1
    assert calls == [1]
    assert_same((await akvs[key()].read())["a"], np.arange(3))


def test_each_call_is_answered_once_or_fails_truly(server_url, raw, key):
    """Eight callers and three servers, of which one is killed now and then: no answer reaches another caller."""
    calls = sized(240, int(os.environ.get("REEM_SERVICE_CALLS", "20000")))
    chance, over = random.Random(1), threading.Event()
    with contextlib.ExitStack() as stack:
        servers = [stack.enter_context(program("serve", server_url, key())) for _ in range(3)]
        callers = [
            stack.enter_context(program("call", server_url, key(), calls // 8, 5, local))
            for local in ["auto", "early"] * 4
        ]

        def kill_now_and_then():
            while not over.wait(chance.uniform(0.2, 0.6)):
                servers.pop(chance.randrange(3)).kill()
                servers.append(stack.enter_context(program("serve", server_url, key())))

        killer = threading.Thread(target=kill_now_and_then)
        killer.start()
        try:
            lines = [line.split() for caller in callers for line in caller.stdout]
        finally:
            over.set()
            killer.join()
    assert len(lines) == calls // 8 * 8
    outcomes = collections.Counter(outcome for _, outcome in lines)
    assert outcomes.keys() <= {"answered", "ServiceLost", "NoService", "Busy"}, outcomes
    assert outcomes["answered"] > 0.9 * len(lines), outcomes
    eventually(lambda: keys_of(raw, key()) == set(), 15)
