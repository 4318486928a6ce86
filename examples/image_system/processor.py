"""Processor: draws the edges of each frame, and tells the actuator where the brightest spot is.

It takes the newest frame: those that come while it is busy are skipped, so it never lags behind.
The result is published for the actuator; the processed picture is only stored, for whoever wants to look.

    python -m examples.image_system.processor --url redis://localhost:6379 [--front asyncio]
"""

from __future__ import annotations

import threading
from argparse import Namespace
from typing import Any

import anyio.to_thread
import numpy as np

import reem
import reem_async
from examples.common import parser, run

BLOCK = 20  # brightness is compared between squares of this many pixels
EDGE = 36  # a step in brightness between neighbours that counts as an edge
GREEN, YELLOW = (60, 255, 120), (255, 210, 0)


def brightest_spot(gray: np.ndarray) -> tuple[int, int]:
    """Row and column of the middle of the brightest square."""
    rows, columns = gray.shape[0] // BLOCK, gray.shape[1] // BLOCK
    squares = gray[: rows * BLOCK, : columns * BLOCK].reshape(rows, BLOCK, columns, BLOCK).sum((1, 3))
    row, column = np.unravel_index(squares.argmax(), squares.shape)
    return int(row) * BLOCK + BLOCK // 2, int(column) * BLOCK + BLOCK // 2


def process(image: np.ndarray) -> tuple[np.ndarray, tuple[int, int]]:
    """The picture with its edges in green and a box around the brightest spot, and that spot."""
    gray = image[..., 1].astype(np.int16)  # the green of a pixel is close enough to its brightness
    steps = abs(gray[2:, 1:-1] - gray[:-2, 1:-1]) + abs(gray[1:-1, 2:] - gray[1:-1, :-2])
    picture = image.copy()  # an array that was read is read-only
    picture[1:-1, 1:-1][steps > EDGE] = GREEN
    row, column = brightest_spot(gray)
    top, left = max(row - 2 * BLOCK, 0), max(column - 2 * BLOCK, 0)
    box = picture[top : row + 2 * BLOCK, left : column + 2 * BLOCK]
    inside = box[3:-3, 3:-3].copy()
    box[:] = YELLOW
    box[3:-3, 3:-3] = inside
    return picture, (row, column)


def result(data: dict[str, Any], spot: tuple[int, int]) -> dict[str, Any]:
    """What the actuator is told; stamp and number are those of the frame."""
    keep = {name: data[name] for name in ("time_stamp", "images_sent", "last")}
    return keep | {"spot": spot, "size": data["image"].shape[:2]}


def blocking(options: Namespace) -> None:
    done = threading.Event()
    with reem.RedisInterface(options.url) as interface:
        kvs, pspace = reem.KeyValueStore(interface), reem.PublishSpace(interface)
        kvs["processor"] = {"ready": False, "frames": 0}

        def on_frame(data: dict[str, Any] | None, updated_path: str) -> None:
            if data is None:  # the server was restarted without it
                return
            picture, spot = process(data["image"])
            pspace["processed_info"] = result(data, spot)
            kvs["processed_image"] = {"image": picture, "images_sent": data["images_sent"]}
            kvs["processor"]["frames"] += 1
            if data["last"]:
                done.set()

        with reem.CallbackSubscriber("raw_image", interface, on_frame, policy=reem.Newest()):
            kvs["processor"]["ready"] = True
            done.wait()
        print(f"processor: {kvs['processor']['frames'].read()} frames processed")


async def asynchronous(options: Namespace) -> None:
    async with reem_async.RedisInterface(options.url) as interface:
        kvs, pspace = reem_async.KeyValueStore(interface), reem_async.PublishSpace(interface)
        await kvs["processor"].write({"ready": False, "frames": 0})
        async with kvs["raw_image"].watch() as updates:
            await kvs["processor"]["ready"].write(True)
            async for update in updates:
                if update.initial or update.deleted:  # of a camera that ran before, or lost in a server's restart
                    continue
                data = update.data
                picture, spot = await anyio.to_thread.run_sync(process, data["image"])
                await pspace["processed_info"].write(result(data, spot))
                await kvs["processed_image"].write({"image": picture, "images_sent": data["images_sent"]})
                frames = await kvs["processor"]["frames"].increment()
                if data["last"]:
                    break
        print(f"processor: {frames} frames processed")


if __name__ == "__main__":
    arguments = parser(__doc__, default="redis://localhost:6379", help="default: %(default)s, where `reem up` is")
    run(arguments.parse_args(), blocking, asynchronous)
