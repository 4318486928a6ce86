"""REEM's programs with a viewer that is not REEM's: what is published is also logged to it, as its manual shows."""

import pathlib
from collections.abc import Callable
from typing import Any

from ..values import ARRAYS, FIELDS, picture
from . import reem_blocking

_Q = FIELDS["state"]["q"]


class Contender(reem_blocking.Contender):
    """One interface, and one connection to the viewer or server for it."""

    def __init__(self, target: dict[str, Any]) -> None:
        options = dict(target["options"])
        self.log = {"rerun": _Rerun, "foxglove": _Foxglove}[options.pop("viewer")](target)
        super().__init__({**target, "options": options})

    def publishing(self, channel: str, payload: str) -> Callable[..., None]:
        """Publish, then log."""
        publish = super().publishing(channel, payload)
        log = self.log.image(channel, payload) if payload in ARRAYS else self.log.state(channel)

        def call(**fields: Any) -> None:
            publish(**fields)
            log(**fields)

        return call


class _Rerun:
    """A stream to the viewer's gRPC server."""

    def __init__(self, target: dict[str, Any]) -> None:
        import rerun

        self.rerun = rerun
        rerun.init("bench", recording_id="bench")
        rerun.connect_grpc(f"rerun+http://127.0.0.1:{target['peer_port']}/proxy")

    def image(self, channel: str, payload: str) -> Callable[..., None]:
        image = picture(payload)
        return lambda: self.rerun.log(channel, self.rerun.Image(image))

    def state(self, channel: str) -> Callable[..., None]:
        return lambda q=_Q: self.rerun.log(f"{channel}/q", self.rerun.Scalars(q))


class _Foxglove:
    """A WebSocket server in this process; a file named after its port lets viewers find it."""

    def __init__(self, target: dict[str, Any]) -> None:
        import foxglove

        self.foxglove = foxglove
        self.server = foxglove.start_server(port=0)
        folder = pathlib.Path(target["folder"], f"foxglove-{target['peer_port']}")
        folder.mkdir(exist_ok=True)
        (folder / str(self.server.port)).touch()

    def image(self, channel: str, payload: str) -> Callable[..., None]:
        from foxglove.messages import RawImage

        image = picture(payload)
        height, width, colours = image.shape

        def log() -> None:
            raw = RawImage(width=width, height=height, encoding="rgb8", step=width * colours, data=image.tobytes())
            self.foxglove.log(f"/{channel}", raw)

        return log

    def state(self, channel: str) -> Callable[..., None]:
        return lambda q=_Q: self.foxglove.log(f"/{channel}", {"q": q})
