"""Camera: publishes a picture, its time stamp and its number, always together.

The picture is a window that moves over a photograph, so that every frame differs from the last one.
A frame is published as one value; nobody ever sees the picture of one frame with the stamp of another.

    python -m examples.image_system.camera --url redis://localhost:6379 --seconds 5 [--front asyncio]
"""

from __future__ import annotations

import importlib.util
import math
import sys
import time
from argparse import Namespace
from pathlib import Path
from typing import Any

import numpy as np

import reem
import reem_async
from examples.common import aticks, parser, run, ticks

HEIGHT, WIDTH = 480, 640
RATE = 30  # frames per second


def photograph() -> np.ndarray:
    """A rocket before its start, as scikit-image ships it, scaled to twice its size."""
    try:
        from PIL import Image
    except ImportError:
        sys.exit("The camera needs Pillow: pip install 'reem-async[demo]'")
    package = importlib.util.find_spec("skimage")  # found, not imported: only its data is needed
    if package is None or package.origin is None:
        sys.exit("The camera needs a photograph from scikit-image: pip install 'reem-async[demo]'")
    with Image.open(Path(package.origin).parent / "data" / "rocket.jpg") as photo:
        return np.asarray(photo.convert("RGB").resize((2 * photo.width, 2 * photo.height)))


def take_picture(photo: np.ndarray, seconds: float) -> np.ndarray:
    """The window that the camera sees at this time, on a slow figure of eight; a view, not a copy."""
    rows, columns = photo.shape[0] - HEIGHT, photo.shape[1] - WIDTH
    top = round(rows * (0.7 + 0.3 * math.sin(1.3 * seconds)))
    left = round(columns * (0.5 + 0.5 * math.sin(0.65 * seconds)))
    return photo[top : top + HEIGHT, left : left + WIDTH]


def frame(photo: np.ndarray, seconds: float, number: int, last: bool) -> dict[str, Any]:
    """What is published."""
    return {
        "image": take_picture(photo, seconds),
        "time_stamp": time.time(),
        "images_sent": number,
        "last": last,  # tells those who follow that no more will come
    }


def blocking(options: Namespace) -> None:
    photo, total = photograph(), round(RATE * options.seconds)
    with reem.RedisInterface(options.url) as interface:
        pspace = reem.PublishSpace(interface)
        for number, seconds in enumerate(ticks(RATE, options.seconds), 1):
            pspace["raw_image"] = frame(photo, seconds, number, last=number == total)
    print(f"camera: {total} frames sent")


async def asynchronous(options: Namespace) -> None:
    photo, total, number = photograph(), round(RATE * options.seconds), 0
    async with reem_async.RedisInterface(options.url) as interface:
        pspace = reem_async.PublishSpace(interface)
        async for seconds in aticks(RATE, options.seconds):
            number += 1
            await pspace["raw_image"].write(frame(photo, seconds, number, last=number == total))
    print(f"camera: {total} frames sent")


if __name__ == "__main__":
    arguments = parser(__doc__, default="redis://localhost:6379", help="default: %(default)s, where `reem up` is")
    arguments.add_argument("--seconds", type=float, default=5.0, help="how long to send; default: %(default)s")
    run(arguments.parse_args(), blocking, asynchronous)
