"""Records set points and a camera with each compression, and has Foxglove's own reader compare every checksum.

Needs node and npm; `make mcap` installs the reader into this folder.
"""

from __future__ import annotations

import asyncio
import json
import subprocess
import tempfile
from pathlib import Path

import numpy as np

import reem_async
from reem_async.server import EmbeddedServer
from reem_async.tools.recording import Recorder

HERE = Path(__file__).parent
UPDATES = 40


async def record(url: str, file: Path, compression: str) -> None:
    async with reem_async.RedisInterface(url, namespace=f"{compression}:") as interface:
        space = reem_async.PublishSpace(interface)
        async with Recorder(interface, ["*"], file, compression=compression, keyframe=0.2):
            for number in range(UPDATES):
                await space["arm"].write({"n": number, "q": [0.1 * number, 1.0], "text": "x" * number})
                await space["camera"].write(np.full((480, 640, 3), number, np.uint8))
                await space["field"].write(np.full((30, 40), number, np.complex128))
                await asyncio.sleep(0.03)
            await space["arm"]["text"].delete()


def main() -> None:
    with EmbeddedServer() as server, tempfile.TemporaryDirectory() as folder:
        for compression in ("zstd", "lz4", "none"):
            file = Path(folder) / f"{compression}.mcap"
            asyncio.run(record(server.url, file, compression))
            said = subprocess.run(["node", HERE / "check.mjs", file], check=True, capture_output=True, text=True)
            found = json.loads(said.stdout)
            assert found["topics"]["/arm"] == UPDATES, found
            assert found["topics"]["/camera"] == UPDATES, found
            print(f"{compression:5} {said.stdout.strip()}")


if __name__ == "__main__":
    main()
