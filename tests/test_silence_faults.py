"""A robot stops in time, whatever fails: its commander is killed or stopped, a link is cut, the server is killed.

No report may come before TTL has passed since the last command was published, on the clock that all processes of a
machine share, nor later than that time and some milliseconds after the command has arrived. For how long a busy machine
did not run the robot's own loop does not count.
"""

import asyncio
import contextlib
import os
import random
import signal
import subprocess
import sys
import threading
import time

import pytest
from chaos.proxy import Proxy
from chaos.servers import PrivateServer
from conftest import FRONTS, eventually

import reem
import reem_async

TTL = 0.2
IN_TIME = 0.02  # seconds after the end of TTL until which silence is reported
BUSY = 0.5  # the same where other tests run beside this one
TIMES = int(os.environ.get("REEM_SILENCE_TIMES", "20"))  # of each fault, alone; 200 take a quarter of an hour

COMMANDER = """
import os, signal, sys, time
import reem
signal.signal(signal.SIGCHLD, signal.SIG_IGN)
parent = os.getpid()

def command(url):
    space = reem.PublishSpace(reem.RedisInterface(url), outage="drop")
    while os.getppid() == parent:
        space["cmd"] = {"t": time.monotonic()}
        time.sleep(0.02)

for url in sys.stdin:
    child = os.fork()
    if not child:
        command(url.strip())
        os._exit(0)
    print(child, flush=True)
"""


class Commander:
    """Publishes at 50 Hz in a process of its own, which is forked anew after each kill."""

    def __init__(self, url):
        self._url = url
        self._parent = subprocess.Popen(
            [sys.executable, "-c", COMMANDER], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
        )
        self.start()

    def start(self):
        self._parent.stdin.write(self._url + "\n")
        self._parent.stdin.flush()
        self.pid = int(self._parent.stdout.readline())

    def signal(self, number):
        os.kill(self.pid, number)

    def close(self):
        self._parent.kill()
        with contextlib.suppress(ProcessLookupError):
            self.signal(signal.SIGKILL)
        self._parent.communicate()


class Observer:
    """What one follower knows: whether it is silent, and how long after the last command each silence was reported."""

    def __init__(self):
        self.live, self.delays, self.reported, self._last = False, [], 0.0, None

    def note(self, command):
        now = time.monotonic()
        if command is not None:
            self._last, self.live = command["t"], True
        elif self.live:
            self.live, self.reported = False, now
            self.delays.append(now - self._last)


class Robot:
    """Follows the commands by a mirror, a loop and a callback at once."""

    def __init__(self, front, url):
        self.observers = self.mirror, self.watch, self.callback = Observer(), Observer(), Observer()
        self._over = False
        self.longest_pause = 0.0  # between two turns of its loop
        self._turned = time.monotonic()
        # When the last command arrived: one of them alone may be in the middle of a read when the link is cut.
        self.arrived = 0.0
        with contextlib.ExitStack() as stack:
            if front == "blocking":
                self._follow(stack, url)
            else:
                thread = threading.Thread(target=asyncio.run, args=(self._follow_async(url),))
                thread.start()
                stack.callback(thread.join, 10)
                stack.callback(setattr, self, "_over", True)
            self.close = stack.pop_all().close

    def _turn(self, mirror):
        now = time.monotonic()
        self.longest_pause, self._turned = max(self.longest_pause, now - self._turned), now
        self.mirror.note(mirror.value(default=None))

    def _watched(self, update):
        self._heard(update)
        self.watch.note(update.data)

    def _called(self, data, updated_path, update):
        self._heard(update)
        self.callback.note(data)

    def _heard(self, update):
        self.arrived = max(self.arrived, update.arrived or 0.0)

    def _silent(self):
        self.callback.note(None)

    def _follow(self, stack, url):
        interface = stack.enter_context(reem.RedisInterface(url))
        place = reem.KeyValueStore(interface)["cmd"]
        mirror, watch = place.mirror(ttl=TTL), place.watch(ttl=TTL)
        mirror.listen()
        reem.CallbackSubscriber("cmd", interface, self._called, ttl=TTL, on_silent=self._silent).listen()

        def poll():
            while not self._over:
                self._turn(mirror)
                time.sleep(0.001)

        def loop():
            for update in watch:
                self._watched(update)

        for target in (poll, loop):
            thread = threading.Thread(target=target)
            thread.start()
            stack.callback(thread.join, 10)
        stack.callback(watch.close)
        stack.callback(setattr, self, "_over", True)

    async def _follow_async(self, url):
        async with reem_async.RedisInterface(url) as interface:
            place = reem_async.KeyValueStore(interface)["cmd"]
            await reem_async.CallbackSubscriber(
                "cmd", interface, self._called, ttl=TTL, on_silent=self._silent
            ).listen()

            async def loop():
                async for update in place.watch(ttl=TTL):
                    self._watched(update)

            async with place.mirror(ttl=TTL) as mirror:
                task = asyncio.create_task(loop())
                while not self._over:
                    self._turn(mirror)
                    await asyncio.sleep(0.001)
                task.cancel()

    def is_(self, live):
        return all(observer.live is live for observer in self.observers)


class Scene:
    """A server, a commander and a robot, each behind a link of its own. For each fault: what it does, and its end."""

    def __init__(self, stack, front):
        self.server = stack.enter_context(PrivateServer())
        self.their_link, self.our_link = (stack.enter_context(Proxy(self.server.port)) for _ in range(2))
        self.commander = stack.enter_context(contextlib.closing(Commander(self.their_link.url)))
        self.robot = stack.enter_context(contextlib.closing(Robot(front, self.our_link.url)))
        self.faults = {
            "killed": (lambda: self.commander.signal(signal.SIGKILL), self.commander.start),
            "stopped": (lambda: self.commander.signal(signal.SIGSTOP), lambda: self.commander.signal(signal.SIGCONT)),
            "link of the commander": (self.their_link.black_hole, lambda: mended(self.their_link)),
            "link of the robot": (self.our_link.black_hole, lambda: mended(self.our_link)),
            "server": (self.server.kill, self.server.start),
        }


def mended(link):
    link.heal()
    link.reset()


@pytest.mark.parametrize("fault", ["killed", "stopped", "link of the commander", "link of the robot", "server"])
@pytest.mark.parametrize("front", list(FRONTS))
@pytest.mark.parametrize(("times", "slack"), [(3, BUSY), pytest.param(TIMES, IN_TIME, marks=pytest.mark.alone)])
def test_silence_is_reported_in_time_and_not_before(front, fault, times, slack):
    with contextlib.ExitStack() as stack:
        scene = Scene(stack, front)
        robot, (break_, mend) = scene.robot, scene.faults[fault]
        eventually(lambda: robot.is_(live=True))
        for number in range(times):
            time.sleep(random.uniform(0.02, 0.06))
            assert [len(observer.delays) for observer in robot.observers] == [number] * 3, "a false alarm"
            robot.longest_pause = 0.0
            break_()
            eventually(lambda: robot.is_(live=False))
            end = robot.arrived + TTL + robot.longest_pause
            late = [observer.reported - end for observer in robot.observers]
            assert max(late) <= slack, late
            mend()
            eventually(lambda: robot.is_(live=True))
        for name in ("mirror", "watch", "callback"):
            delays = sorted(getattr(robot, name).delays)
            print(f"{front} {fault} {name}: {1000 * delays[0]:.1f} to {1000 * delays[-1]:.1f} ms, {len(delays)} times")
            assert delays[0] >= TTL


@pytest.mark.alone
@pytest.mark.parametrize("front", list(FRONTS))
def test_there_is_no_false_alarm_under_load(front):
    with contextlib.ExitStack() as stack:
        robot = Scene(stack, front).robot
        eventually(lambda: robot.is_(live=True))
        for _ in range(os.cpu_count() or 1):
            spinning = subprocess.Popen([sys.executable, "-c", "while True: pass"])
            stack.callback(spinning.wait)
            stack.callback(spinning.kill)
        time.sleep(60)
        assert [observer.delays for observer in robot.observers] == [[], [], []]
