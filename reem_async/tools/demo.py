"""The three programs of the demonstration: `python -m reem_async.tools.demo arm redis://localhost:6379`.

They share nothing but what is in REEM:

    goal        where the ball is to be put: x, y; anybody may write it
    command     joints and grip that the arm is to have                 controller -> arm
    arm         joints and grip that it has, and where its hand is      arm -> camera, controller
    world       where the ball is                                       arm -> camera
    camera      the picture                                             camera -> controller
    detection   where the controller finds the ball in the picture
    controller  what it does, and how far the hand is from where it should be

Before the programs come the arm's geometry and what its camera sees. Lengths are metres, angles radians; z points up
from the table.
"""

from __future__ import annotations

import asyncio
import math
import os
import sys
import threading
import time
from collections.abc import AsyncIterator, Sequence
from itertools import cycle, pairwise
from typing import Any

import numpy as np
from PIL import Image, ImageDraw, ImageFilter

from reem_async.connection import RedisInterface
from reem_async.store.store import KeyValueStore, PublishSpace

Array = np.ndarray[Any, Any]

SHOULDER, UPPER, FORE, HAND = 0.13, 0.30, 0.27, 0.10  # height of the shoulder, lengths of the links
BALL_RADIUS = 0.035
REACH = (0.18, 0.5)  # distances from the base at which the hand can take something off the table

WIDTH, HEIGHT = 480, 360
_FINE = 2  # drawn so much larger, then reduced: smooth edges
_EYE, _CENTRE = np.array([1.02, -0.62, 0.78]), np.array([0.06, 0.0, 0.14])
_FOCAL = 520.0 * _FINE
_TRAIL = 40  # positions of the hand

_ORANGE, _TEAL, _STEEL, _DARK = (255, 140, 40), (45, 212, 191), (214, 222, 235), (52, 62, 82)


def angles_to(place: Sequence[float]) -> Array:
    """Return base, shoulder, elbow and wrist with which the hand is at a place and points down."""
    x, y, z = place
    across, up = math.hypot(x, y), z + HAND - SHOULDER
    distance = min(math.hypot(across, up), UPPER + FORE - 1e-6)
    elbow = -math.acos(max(-1.0, (distance**2 - UPPER**2 - FORE**2) / (2 * UPPER * FORE)))
    shoulder = math.atan2(up, across) - math.atan2(FORE * math.sin(elbow), UPPER + FORE * math.cos(elbow))
    return np.array([math.atan2(y, x), shoulder, elbow, -math.pi / 2 - shoulder - elbow])


def points_of(angles: Sequence[float]) -> Array:
    """Return the ends of the links, from the base up."""
    base, *pitches = angles
    points, pitch = [np.zeros(3), np.array([0.0, 0.0, SHOULDER])], 0.0
    for length, bend in zip((UPPER, FORE, HAND), pitches, strict=True):
        pitch += bend
        way = np.array([math.cos(base) * math.cos(pitch), math.sin(base) * math.cos(pitch), math.sin(pitch)])
        points.append(points[-1] + length * way)
    return np.array(points)


class Camera:
    """Draws the scene, and tells from a pixel which place on the table it shows."""

    def __init__(self) -> None:
        forward = (_CENTRE - _EYE) / np.linalg.norm(_CENTRE - _EYE)
        right = np.cross(forward, [0.0, 0.0, 1.0])
        right /= np.linalg.norm(right)
        self._axes = np.array([right, np.cross(forward, right), forward])
        self._background = self._table()
        self._trail: list[Array] = []

    def _seen(self, places: Any) -> Array:
        """Return pixels, and how many of them are a metre there."""
        x, y, depth = self._axes @ (np.atleast_2d(places) - _EYE).T
        scale = _FOCAL / depth
        return np.stack([_FINE * WIDTH / 2 + scale * x, _FINE * HEIGHT / 2 + scale * y, scale], axis=1)

    def place(self, pixel: Sequence[float], height: float) -> Array:
        """Return the place at a height above the table that a pixel of the picture shows."""
        x, y = pixel[0] - WIDTH / 2, pixel[1] - HEIGHT / 2
        ray = self._axes.T @ [x * _FINE, y * _FINE, _FOCAL]
        return np.array(_EYE + ray * (height - _EYE[2]) / ray[2])

    def _table(self) -> Image.Image:
        rows = np.linspace(0.0, 1.0, _FINE * HEIGHT)[:, None, None]
        shade = np.array([24, 32, 50]) * (1 - rows) + np.array([40, 52, 76]) * rows
        image = Image.fromarray(np.broadcast_to(shade, (_FINE * HEIGHT, _FINE * WIDTH, 3)).astype(np.uint8))
        draw = ImageDraw.Draw(image)
        for step in range(-8, 9):
            for line in ([[step / 10, -0.8, 0], [step / 10, 0.8, 0]], [[-0.8, step / 10, 0], [0.8, step / 10, 0]]):
                draw.line([tuple(point[:2]) for point in self._seen(line)], fill=(58, 72, 102), width=_FINE)
        for radius in REACH:
            self._ring(draw, (0.0, 0.0), radius, (72, 92, 128), _FINE)
        return image

    def _ring(self, draw: Any, centre: Sequence[float], radius: float, colour: Any, width: int) -> None:
        turn = np.linspace(0, 2 * math.pi, 49)
        circle = np.stack([radius * np.cos(turn), radius * np.sin(turn), 0 * turn], axis=1) + np.array([*centre, 0.0])
        draw.line([tuple(point[:2]) for point in self._seen(circle)], fill=colour, width=width, joint="curve")

    def picture(self, angles: Sequence[float], grip: float, ball: Sequence[float], goal: Any, moment: float) -> Array:
        """Return the scene as an image: uint8, (rows, columns, 3)."""
        points = points_of(angles)
        self._trail = [*self._trail[1 - _TRAIL :], points[-1]]
        image = self._background.copy()
        image.paste((10, 14, 24), mask=self._shadow(points, ball))
        draw = ImageDraw.Draw(image, "RGBA")
        if goal is not None:
            for ring in range(3):
                fade = (moment + ring / 3) % 1
                self._ring(draw, goal, 0.025 + 0.06 * fade, (*_TEAL, int(255 * (1 - fade))), 2 * _FINE)
        trail = self._seen(self._trail)
        for number, (one, other) in enumerate(pairwise(trail)):
            draw.line([*one[:2], *other[:2]], fill=(*_ORANGE, 4 * number), width=2 * _FINE)
        # From the farthest part to the nearest: the four links, and then the ball as number 4.
        middles = np.vstack([(points[:-1] + points[1:]) / 2, ball])
        for number in np.argsort(-np.linalg.norm(middles - _EYE, axis=1)):
            if number == 4:
                self._ball(draw, ball)
            else:
                self._link(draw, points, number, grip)
        return np.array(image.reduce(_FINE))

    def _shadow(self, points: Array, ball: Sequence[float]) -> Image.Image:
        """Return where light from above is kept off the table, with soft edges."""
        mask = Image.new("L", (WIDTH, HEIGHT))
        draw = ImageDraw.Draw(mask)
        on_table = self._seen(points * [1, 1, 0]) / _FINE
        draw.line([tuple(point[:2]) for point in on_table], fill=120, width=14, joint="curve")
        for (x, y, scale), radius in ((on_table[0], 0.09), (self._seen([*ball[:2], 0])[0] / _FINE, BALL_RADIUS)):
            size = radius * scale
            draw.ellipse([x - size, y - 0.6 * size, x + size, y + 0.6 * size], fill=150)
        return mask.filter(ImageFilter.GaussianBlur(4)).resize((_FINE * WIDTH, _FINE * HEIGHT))

    def _ball(self, draw: Any, ball: Sequence[float]) -> None:
        x, y, scale = self._seen(ball)[0]
        size, dark, bright = BALL_RADIUS * scale, np.array([214, 88, 18]), np.array([255, 196, 120])
        for part in np.linspace(1.0, 0.15, 8):
            shift = 0.4 * size * (1 - part)
            _disc(draw, x - shift, y - shift, size * part, dark + (bright - dark) * (1 - part))

    def _link(self, draw: Any, points: Array, number: int, grip: float) -> None:
        """Draw a link with its joint, or the hand with its fingers."""
        (x, y, scale), (to_x, to_y, to_scale) = self._seen(points[number : number + 2])
        half = (0.042, 0.033, 0.027, 0.018)[number] * scale
        if number == 3:
            self._fingers(draw, points, grip)
        # From its dark edge to the light on its upper left side.
        for part, light in ((1.0, 0.62), (0.84, 0.84), (0.55, 1.0), (0.2, 1.1)):
            tone = np.array((_DARK, _STEEL, _STEEL, _DARK)[number]) * light
            shift = 0.32 * half * (1 - part)
            ends = [x - shift, y - shift, to_x - shift, to_y - shift]
            draw.line(ends, fill=_colour(tone), width=max(1, round(2 * half * part)))
            _disc(draw, x - shift, y - shift, half * part, tone)
            _disc(draw, to_x - shift, to_y - shift, half * part * to_scale / scale, tone)
        if number:
            _disc(draw, x, y, 0.62 * half, _DARK)
            _disc(draw, x, y, 0.34 * half, _TEAL)

    def _fingers(self, draw: Any, points: Array, grip: float) -> None:
        way = (points[4] - points[3]) / np.linalg.norm(points[4] - points[3])
        side = np.cross(way, [1.0, 0.0, 0.0] if abs(way[2]) > 0.9 else [0.0, 0.0, 1.0])
        for sign in (-1, 1):
            knuckle = points[4] - 0.02 * way + sign * side * (BALL_RADIUS * 0.75 + 0.03 * grip)
            finger = self._seen([points[4] - 0.03 * way, knuckle, knuckle + 0.055 * way])
            width = round(0.014 * finger[0][2])
            draw.line([tuple(each[:2]) for each in finger], fill=_STEEL, width=width, joint="curve")


def _disc(draw: Any, x: float, y: float, radius: float, colour: Any) -> None:
    draw.ellipse([x - radius, y - radius, x + radius, y + radius], fill=_colour(colour))


def _colour(tone: Any) -> tuple[int, ...]:
    return tuple(min(255, int(each)) for each in tone)


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
