"""What a person's viewer asks of a robot: `python -m benchmarks.workers.viewer page|foxglove|bridge ...`.

`page ADDRESS CAMERA` takes what REEM's page does, `foxglove FOLDER` what the servers named in a folder send, and
`bridge PORT` what `reem foxglove` sends.

It stands for a viewer on another computer: it takes what a viewer takes, and draws nothing. The first picture that it
has is reported by a line on stdout. It goes on until it is killed.
"""

import json
import pathlib
import sys
import threading
import time
import urllib.error
import urllib.parse
import urllib.request
from collections.abc import Callable
from typing import Any

_EVERY = 0.1  # seconds between two looks of REEM's page
_LARGE = 100_000  # bytes; a message of so many has a picture
_seen = threading.Event()


def page(address: str, camera: str) -> None:
    """Read the tree and the camera's picture as often as the page does at most."""
    picture = urllib.parse.urlencode({"path": f"{camera}.image", "side": 480})
    while True:
        time.sleep(_EVERY)
        try:
            for path in ("tree?open=200:0:", f"image?{picture}"):
                with urllib.request.urlopen(f"{address}api/{path}", timeout=10) as reply:
                    reply.read()
            report()
        except urllib.error.HTTPError:
            continue  # the camera has not published yet


def foxglove(folder: str) -> None:
    """Subscribe to all channels of each server as it comes."""
    from websockets.sync.client import connect  # before the threads, which would import it at the same time

    known: set[str] = set()
    while True:
        for path in pathlib.Path(folder).glob("*"):
            if path.name not in known:
                known.add(path.name)
                threading.Thread(target=take_all, args=(connect, path.name), daemon=True).start()
        time.sleep(0.1)


def bridge(port: str) -> None:
    """Subscribe to all channels of one server."""
    from websockets.sync.client import connect

    take_all(connect, port)


def take_all(connect: Callable[..., Any], port: str) -> None:
    """Receive all messages of one server."""
    address = f"ws://127.0.0.1:{port}"
    with connect(address, subprotocols=["foxglove.sdk.v1"], max_size=None, compression=None) as socket:
        for message in socket:
            if isinstance(message, bytes):
                if len(message) > _LARGE:
                    report()
                continue
            channels = json.loads(message).get("channels", [])
            wanted = [{"id": channel["id"], "channelId": channel["id"]} for channel in channels]
            if wanted:
                time.sleep(0.2)  # foxglove-sdk 0.30 announces a channel a moment before it accepts subscriptions
                socket.send(json.dumps({"op": "subscribe", "subscriptions": wanted}))


def report() -> None:
    """Print a line, once."""
    if not _seen.is_set():
        _seen.set()
        print("a picture", flush=True)


if __name__ == "__main__":
    {"page": page, "foxglove": foxglove, "bridge": bridge}[sys.argv[1]](*sys.argv[2:])
