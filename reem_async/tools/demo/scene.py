"""The arm's geometry, and what its camera sees. Lengths are metres, angles radians; z points up from the table."""

from __future__ import annotations

import math
from collections.abc import Sequence
from itertools import pairwise
from typing import Any

import numpy as np
from PIL import Image, ImageDraw, ImageFilter

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
