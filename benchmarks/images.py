"""What JPEG costs beside an array: `python -m benchmarks.images` prints a table, which is in docs/howto/images.md.

The picture is of a camera, as far as that can be made without one: smooth shapes, edges, and noise of two levels.
"""

import statistics
import time

import numpy as np

import reem
from reem_async.server import EmbeddedServer
from reem_async.ships import images

ROUNDS = 60
SIZES = {"640x480": (480, 640), "1920x1080": (1080, 1920)}


def camera(rows, columns):
    row, column = np.mgrid[0:rows, 0:columns]
    shade = np.stack([row * 255 // rows, column * 255 // columns, (row + column) % 256], 2)
    shade[(row // 60 + column // 80) % 3 == 0] //= 2
    noise = np.random.default_rng(0).normal(0, 2, shade.shape)
    return np.clip(shade + noise, 0, 255).astype(np.uint8)


def median(work):
    times = []
    for _ in range(ROUNDS):
        start = time.perf_counter()
        work()
        times.append(time.perf_counter() - start)
    return statistics.median(times) * 1000


def measured(url, frame, encoded):
    """Bytes of a frame that reach the server, and milliseconds of a publisher's call and of a read."""
    with reem.RedisInterface(url, local="off") as interface:
        robot, kvs = reem.PublishSpace(interface), reem.KeyValueStore(interface)

        def publish():
            robot["camera"] = {"t": 1.5, "rgb": reem.Jpeg(frame, 85) if encoded else frame}

        publish()
        before = interface.client.info("stats")["total_net_input_bytes"]
        call = median(publish)
        sent = (interface.client.info("stats")["total_net_input_bytes"] - before) / ROUNDS
        return sent, call, median(kvs["camera"].read)


def main():
    real = images._module
    ways = {"array": None, "Jpeg, simplejpeg": (), "Jpeg, Pillow": ("simplejpeg",)}
    print("| | KB to the server | publisher's call, ms | reader's `read()`, ms |\n|---|---|---|---|")
    with EmbeddedServer() as server:
        for size, (rows, columns) in SIZES.items():
            for way, away in ways.items():
                images._module = lambda name, away=away: None if name in (away or ()) else real(name)
                sent, call, read = measured(server.url, camera(rows, columns), away is not None)
                print(f"| {size}, {way} | {sent / 1000:,.0f} | {call:.1f} | {read:.1f} |")
    images._module = real


if __name__ == "__main__":
    main()
