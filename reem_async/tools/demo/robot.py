"""The three programs of the demonstration: `python -m reem_async.tools.demo.robot arm redis://localhost:6379`.

They share nothing but what is in REEM:

    goal        where the ball is to be put: x, y; anybody may write it
    command     joints and grip that the arm is to have                 controller -> arm
    arm         joints and grip that it has, and where its hand is      arm -> camera, controller
    world       where the ball is                                       arm -> camera
    camera      the picture                                             camera -> controller
    detection   where the controller finds the ball in the picture
    controller  what it does, and how far the hand is from where it should be
"""

from __future__ import annotations

import asyncio
import math
import os
import sys
import threading
import time
from collections.abc import AsyncIterator, Sequence
from itertools import cycle
from typing import Any

import numpy as np

from reem_async.connection import RedisInterface
from reem_async.store.store import KeyValueStore, PublishSpace
from reem_async.tools.demo.scene import BALL_RADIUS, REACH, Array, Camera, angles_to, points_of

ARM_HZ, CAMERA_HZ, CONTROL_HZ = 50, 12, 25
FASTEST = 1.8  # radians a second
TOUR = ((0.12, 0.38), (0.34, -0.2), (0.4, 0.14), (0.1, -0.42), (0.28, 0.3))
HOME, ABOVE = (0.16, 0.0, 0.36), 0.16  # where the hand waits, and how high it carries the ball, in metres
REST_SECONDS, HELD_SECONDS = 1.0, 8.0  # at a goal of the tour, and at one that somebody wrote


async def every(hertz: float) -> AsyncIterator[float]:
    """Yield the time, so many times a second."""
    when = time.monotonic()
    while True:
        yield time.time()
        when = max(when + 1 / hertz, time.monotonic() - 1)
        await asyncio.sleep(max(when - time.monotonic(), 0))


async def arm(interface: RedisInterface) -> None:
    """Simulate joints that follow the command as fast as they can, and a ball that the hand can take."""
    kvs, space = KeyValueStore(interface), PublishSpace(interface)
    joints, grip, ball, is_held = angles_to(HOME), 1.0, np.array([*TOUR[1], BALL_RADIUS]), False
    async with kvs["command"].mirror() as command:
        async for _ in every(ARM_HZ):
            wanted = command.value() or {"joints": joints, "grip": grip}
            most = FASTEST / ARM_HZ
            joints = joints + np.clip(0.15 * (wanted["joints"] - joints), -most, most)
            grip += float(np.clip(wanted["grip"] - grip, -3 / ARM_HZ, 3 / ARM_HZ))
            hand = points_of(joints)[-1]
            is_held = grip < 0.5 and (is_held or float(np.linalg.norm(hand - ball)) < 0.04)
            if is_held:
                ball = hand
            elif ball[2] > BALL_RADIUS:
                ball = np.array([*ball[:2], max(ball[2] - 0.7 / ARM_HZ, BALL_RADIUS)])
            await space.update(
                arm={"joints": joints.round(5), "grip": round(grip, 5), "hand": hand.round(5)},
                world={"ball": dict(zip("xyz", ball.round(5).tolist(), strict=True))},
            )


async def camera(interface: RedisInterface) -> None:
    """Publish a picture of the arm, the ball and the goal."""
    kvs, space, eye = KeyValueStore(interface), PublishSpace(interface), Camera()
    async with kvs["arm"].mirror() as state, kvs["world"].mirror() as world, kvs["goal"].mirror() as goal:
        async for moment in every(CAMERA_HZ):
            if (at := state.value()) and (there := world.value()):
                ball, aim = tuple(there["ball"].values()), place_of(goal.value())
                await space["camera"].write({"rgb": eye.picture(at["joints"], at["grip"], ball, aim, moment)})


def place_of(goal: Any) -> tuple[float, float] | None:
    """Return a goal as somebody wrote it, moved to where the hand can get; None if it is no place."""
    try:
        x, y = float(goal["x"]), float(goal["y"])
    except (KeyError, TypeError, ValueError):
        return None
    distance, turn = min(max(math.hypot(x, y), REACH[0]), REACH[1]), math.atan2(y, x)
    return distance * math.cos(turn), distance * math.sin(turn)


async def control(interface: RedisInterface) -> None:
    """Find the ball in the camera's pictures, and have the arm carry it to the goal."""
    controller = Controller(interface)
    await controller.space["goal"].write(dict(zip("xy", TOUR[0], strict=True), by="tour"))
    async with asyncio.TaskGroup() as tasks:
        tasks.create_task(controller.look())
        tasks.create_task(controller.act())


class Controller:
    """Takes the ball from where the camera sees it to the goal, and then on to the next one."""

    def __init__(self, interface: RedisInterface) -> None:
        self.kvs, self.space = KeyValueStore(interface), PublishSpace(interface)
        self.eye = Camera()
        self.seen: Array | None = None
        self.grip = 1.0

    async def look(self) -> None:
        """Find the ball in each picture: the middle of what is orange."""
        async for update in self.kvs["camera"].watch():
            if update.data is None:
                continue
            pixels = update.data["rgb"][::4, ::4].astype(np.float32) / 255
            orange = np.clip(pixels[..., 0] - pixels[..., 2] - 0.1, 0, None)
            edges = np.hypot(*np.gradient(pixels.mean(axis=2)))
            rows, columns = np.nonzero(orange > 0.4)
            found: dict[str, Any] = {"label": "nothing"}
            if len(rows) >= 4:
                self.seen = self.eye.place((4 * columns.mean() + 2, 4 * rows.mean() + 2), BALL_RADIUS)
                x, y, _ = self.seen.round(4).tolist()
                box = np.array([columns.min(), rows.min(), columns.max() + 1, rows.max() + 1]) * 4
                found = {"label": "ball", "x": x, "y": y, "box": box.tolist()}
            await self.space["detection"].write({**found, "heat": orange + edges})

    async def act(self) -> None:
        """Fetch the ball whenever it is not at the goal."""
        tour = cycle([*TOUR[1:], TOUR[0]])
        async with self.kvs["goal"].mirror() as goal, self.kvs["arm"].mirror() as state:
            self.goal, self.state = goal, state
            while True:
                target = place_of(goal.value())
                if self.seen is None or target is None:
                    await self.move("wait", HOME, 0.2)
                elif math.dist(self.seen[:2], target) > 0.05:
                    await self.fetch(*self.seen[:2])
                else:
                    was = goal.value()
                    await self.move("rest", HOME, REST_SECONDS if was.get("by") == "tour" else HELD_SECONDS)
                    if goal.value() == was:
                        await self.space["goal"].write(dict(zip("xy", next(tour), strict=True), by="tour"))

    async def fetch(self, x: float, y: float) -> None:
        """Take the ball from a place and carry it to the goal, also if the goal moves meanwhile."""
        await self.move("reach", (x, y, ABOVE))
        await self.move("lower", (x, y, BALL_RADIUS))
        self.grip = 0.0
        await self.move("grasp", (x, y, BALL_RADIUS), 0.5)
        await self.move("lift", (x, y, ABOVE))
        while (target := place_of(self.goal.value())) and await self.move("carry", (*target, ABOVE)):
            pass
        if target:
            await self.move("place", (*target, BALL_RADIUS))
        self.grip = 1.0
        await self.move("open", self.state.value()["hand"], 0.4)
        await self.move("retreat", HOME)
        self.seen = None  # where it is now, the next picture tells
        await self.move("look", HOME, 0.4)

    async def move(self, doing: str, place: Sequence[float], seconds: float | None = None) -> bool:
        """Send the hand to a place, until it is there, or for so long; return whether the goal has moved meanwhile."""
        joints, aim, begun = angles_to(place), place_of(self.goal.value()), time.time()
        async for moment in every(CONTROL_HZ):
            state = self.state.value()
            error = round(math.dist(state["hand"], place), 5) if state else 1.0
            at_once = {"command": {"joints": joints, "grip": self.grip}, "controller": {"doing": doing, "error": error}}
            await self.space.update(at_once)
            has_moved = place_of(self.goal.value()) != aim
            is_late = moment - begun > (seconds or 4.0)
            if is_late or (has_moved and doing in ("carry", "rest")) or (seconds is None and error < 0.008):
                break
        return has_moved


async def main(part: str, url: str) -> None:
    """Run one of the programs until its standard input ends, as it does when the command ends, however it ends."""
    threading.Thread(target=lambda: os._exit(len(os.read(0, 1))), daemon=True).start()
    async with RedisInterface(url) as interface:
        await {"arm": arm, "camera": camera, "controller": control}[part](interface)


if __name__ == "__main__":
    asyncio.run(main(*sys.argv[1:]))
