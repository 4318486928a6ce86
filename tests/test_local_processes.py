"""Large values through shared memory, and what befalls the processes: forks, ends, limits, other users, kill -9."""

import contextlib
import os
import subprocess
import sys

import orjson
import pytest
from conftest import PATIENCE, ROOT, SLOW_MACHINE, eventually, line_of
from localkit import EXITS, STEPS, frame, is_whole
from slotkit import in_slot

import reem
from reem_async.local import segment as local_segment
from reem_async.local.segment import reason_against
from reem_async.plan.keys import keys_of

pytestmark = pytest.mark.skipif(bool(reason_against()), reason=f"no shared memory: {reason_against()}")


@contextlib.contextmanager
def started(*words):
    """One of the programs of localkit.py, running; it ends by itself, well, and complains of nothing."""
    command = [sys.executable, "-X", "dev", "-W", "error", str(ROOT / "tests/localkit.py"), *map(str, words)]
    pipes = dict.fromkeys(("stdin", "stdout", "stderr"), subprocess.PIPE)
    with subprocess.Popen(command, text=True, cwd=ROOT, **pipes) as process:
        try:
            yield process
            _, complaints = process.communicate(timeout=2 * PATIENCE)
            assert (process.returncode, SLOW_MACHINE.sub("", complaints)) == (0, "")
        finally:
            process.kill()


def line(process):
    return line_of(process.stdout.fileno()).strip() or process.communicate()[1]


def order(process, words):
    process.stdin.write(f"{words}\n")
    process.stdin.flush()


@pytest.fixture
def following(server_url):
    with reem.RedisInterface(server_url) as interface:
        yield interface


@pytest.fixture
def mirror(following, key):
    mirror = reem.SilentSubscriber(key("cam"), following)
    mirror.listen()
    return mirror


def test_a_child_of_a_reader_unlocks_nothing_and_keeps_what_it_has(server_url, key):
    with started("fork_reader", server_url, key("cam")) as process:
        assert line(process) == "kept by the parent: True"
        assert line(process) == "kept by the child: True"


def test_a_child_of_a_publisher_has_memory_of_its_own(server_url, key):
    with started("fork_publisher", server_url, key("cam")) as process:
        assert line(process) == "child: True"
        assert line(process) == "kept: True True"
        assert line(process) == "parent: True True"


@pytest.mark.long
@pytest.mark.parametrize("name", EXITS)
def test_an_interpreter_that_ends_while_frames_are_looked_at_says_nothing(name, server_url, key):
    with started(name, server_url, key("cam")) as process:
        assert line(process) == "True"


@pytest.mark.skipif(os.geteuid() != 0, reason="only root can be somebody else")
def test_another_user_of_this_host_gets_the_frame_from_the_server(server_url, key, pspace, mirror, raw):
    with started("another_user", server_url, key("cam"), 65534) as process, raw.pubsub() as heard:
        assert line(process) == "ready"
        heard.subscribe(keys_of(key("cam")).channel)
        pspace[key("cam")] = frame(1)
        eventually(lambda: mirror.value() is not None)
        assert in_slot(mirror.value()["image"])
        assert line(process) == "False True"
        message = eventually(lambda: (found := heard.get_message()) and found["type"] == "message" and found["data"])
        order(process, " ".join(map(str, orjson.loads(message)[-1][0][1:6])))
        assert line(process) == "None"
        assert line(process) == "refused"


@pytest.mark.parametrize("mode", ["auto", pytest.param("early", marks=pytest.mark.long)])
def test_a_publisher_that_is_killed_at_any_step_leaves_nothing_and_spoils_nothing(
    mode, server_url, key, pspace, kvs, mirror, following, monkeypatch
):
    """Readers have what the server has, others publish, and no memory of it is looked into any more."""
    monkeypatch.setattr(local_segment, "_IDLE", 0.0)
    mappings, killed = following._followers.session.local.reader._mappings, set()
    with started("killed_at", server_url, key("cam"), mode) as process:
        for step in STEPS:
            if step == "told early, not stored" and mode != "early":
                continue
            order(process, step)
            pid, code = map(int, line(process).split())
            assert code == -9, step
            killed.add(pid)
            stored = kvs[key("cam")].read()
            assert stored["n"] == (2 if step == "stored" else 3 if "memory" in step else 1), step
            eventually(lambda stored=stored: (mirror.value() or {}).get("n") == stored["n"])
            assert is_whole(mirror.value()), step
            pspace[key("cam")] = frame(3)
            eventually(lambda: mirror.value()["n"] == 3)
            assert is_whole(mirror.value()), step
    assert in_slot(mirror.value()["image"])
    eventually(lambda: not killed & {process for process, *_ in [*mappings]})
