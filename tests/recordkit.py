"""Recordings that are written without a server, at once."""

import numpy as np

from reem_async.ships.registry import Ships, default_ships
from reem_async.tools.recording.format import Role
from reem_async.tools.recording.sink import Sink
from reem_async.tools.recording.writer_thread import Operation, WriterThread
from reem_async.transport.protocol import CommandRecorder

START, STEP = 1_700_000_000_000_000_000, 250_000_000


def write_mixed(file, steps=40, flush=4):
    """A key with a number and a picture in one dict, and one with numbers only; a flush for every four of them."""
    sink = Sink(file, "zstd", {}, overwrite=False)
    sink.output.appear()
    writer = WriterThread(sink, Ships(default_ships(), CommandRecorder), 0)
    for step in range(steps):
        now = START + step * STEP
        picture = np.full((100, 100), step % 256, np.uint8)
        writer._write(Operation(Role.UPDATE, ("cam",), {"t": step, "rgb": picture}, (now, now, step)))
        joints = {"q": np.full(7, step / 2), "n": step, "mode": f"m{step}", "big": 2**60 + step, "a": [step] * 3}
        writer._write(Operation(Role.UPDATE, ("arm",), joints, (now + 2000, now, step)))
        if step % flush == flush - 1:
            sink._closed_at -= 1
            sink.tick()
    sink.finish({})
    return file
