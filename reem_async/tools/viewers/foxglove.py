"""Keys and parameters, live in Foxglove: a server of its protocol.

A key is a topic `/arm`: JSON, as in a recording, after each update of anything in it. An array or picture in it is a
topic of its own, `/camera/image`. What no client has subscribed to is neither followed nor encoded.
"""

from __future__ import annotations

import asyncio
import logging
import time
from collections import Counter
from collections.abc import Sequence
from typing import Any

from ...concurrency.queues import Last
from ...concurrency.tasks import come_last
from ...connection import RedisInterface
from ...coordination.parameters import SPECIFICATIONS, StoredParameter, publish, stored_parameters
from ...coordination.specification import as_json
from ...errors import NotAllowed, RedisError, ReemError, ServerFailed
from ...plan.paths import Path, show
from ...plan.trees import MISSING
from .base import Viewer, extra
from .topics import Topics

logger = logging.getLogger("reem.foxglove")

_BACKLOG = 128
"""Messages that wait for a slow client before the oldest is dropped: of pictures, hundreds of MB."""
_WAITING = 1000  # updates of a key that wait here
_PARAMETERS_EVERY = 1.0  # seconds
_REPORT_EVERY = 5.0  # seconds between two reports of losses
_ANSWER = 5.0  # seconds within which a parameter must be stored


class Bridge:
    """A server of Foxglove's protocol, and what its clients ask for. Their requests come on threads of the server.

    Attributes:
        owner: What answers the requests.
        topics: What clients can subscribe to.
        address: Where it listens, such as "ws://127.0.0.1:8765".
        link: The address of Foxglove's page in the web browser, which connects to it.
    """

    def __init__(
        self, owner: Any, title: str, host: str, port: int, topics: Topics, foxglove: Any, options: dict[str, Any]
    ) -> None:
        self.owner, self.topics = owner, topics
        try:
            self.server = foxglove.start_server(
                name=title,
                host=host,
                port=port,
                server_listener=self,
                context=topics.context,
                message_backlog_size=_BACKLOG,
                **options,
            )
        except (RuntimeError, OSError) as error:
            raise ServerFailed(f"cannot listen on {host} port {port}: {error}; use another --host or --port") from None
        self.address = f"ws://{f'[{host}]' if ':' in host else host}:{self.server.port}"
        self.link = str(self.server.app_url() or "")

    def on_subscribe(self, client: Any, channel: Any) -> None:
        self.topics.subscribed(channel.id)

    def on_unsubscribe(self, client: Any, channel: Any) -> None:
        """Do nothing: the channel knows whether a client wants it."""


class FoxgloveViewer(Viewer):
    """Keys and parameters of a server, live.

    Args:
        interface: The server; it is not closed.
        patterns: Globs of top-level keys; all if there is none.
        host: Where to listen.
        port: The port; 0 for a free one.
        rate: Messages a second of each array and picture, at most.
        allow_write: Clients may set parameters.
    """

    def __init__(
        self,
        interface: RedisInterface,
        patterns: Sequence[str] = (),
        *,
        host: str = "127.0.0.1",
        port: int = 8765,
        rate: float = 30.0,
        allow_write: bool = False,
    ) -> None:
        super().__init__(interface, patterns, lambda: Last(_WAITING))
        come_last()  # before the server begins its threads, which inherit it
        foxglove = extra("foxglove", "foxglove-sdk")
        self._foxglove = foxglove
        self._topics = Topics(foxglove, rate, self.skipped)
        self._allow_write = allow_write
        self.loop = asyncio.get_running_loop()  # of its coroutines, which threads of the server call
        self._parameters: dict[str, Any] = {}  # what subscribed clients know
        self._parameters_due = self._report_due = 0.0
        self._subscribed: set[str] = set()
        self._reported: Counter[str] = Counter()
        options = {"capabilities": [foxglove.Capability.Parameters], "supported_encodings": ["json"]}
        self.bridge = LiveBridge(self, f"REEM {interface.hostname}", host, port, self._topics, foxglove, options)

    def wants(self, name: str) -> bool | None:
        return self._topics.wants(name)

    def show(self, name: str, tree: Any, at: int) -> None:
        self._topics.show(name, tree, at)

    def gone(self, name: str) -> None:
        self._topics.gone(name)

    async def tick(self) -> None:
        self._topics.tick()
        now = time.monotonic()
        if self._subscribed and now >= self._parameters_due:
            self._parameters_due = now + _PARAMETERS_EVERY
            await self._publish_parameters()
        if now >= self._report_due:
            self._report_due = now + _REPORT_EVERY
            self._report()

    async def run(self) -> None:
        try:
            await super().run()
        finally:
            self.bridge.server.stop()

    def _report(self) -> None:
        """Show clients how many updates they did not get."""
        losses = self.losses
        for name, count in (losses - self._reported).items():
            text = f"{count} updates of {show((name,))} were left out or lost in the last {_REPORT_EVERY:g} s"
            self.bridge.server.publish_status(text, self._foxglove.StatusLevel.Warning, name)
        self._reported = losses

    # Parameters.

    async def _publish_parameters(self) -> None:
        try:
            found = {it.name: as_json(it.used) for it in (await self._stored()).values()}
        except (ReemError, RedisError, OSError) as error:
            logger.debug("parameters cannot be read: %s", error)
            return
        changed = [
            name for name in self._subscribed & found.keys() if self._parameters.get(name, MISSING) != found[name]
        ]
        self._parameters = found
        if changed:
            self.bridge.server.publish_parameter_values([self._shown(name, found[name]) for name in sorted(changed)])

    async def _stored(self) -> dict[Path, StoredParameter]:
        try:
            return (await stored_parameters(self.session))[0]
        except NotAllowed as error:
            logger.warning("%s cannot be read, so there are no parameters: %s", SPECIFICATIONS, error)
            return {}

    def _shown(self, name: str, value: Any) -> Any:
        return self._foxglove.Parameter(name, value=value)

    async def parameters(self, names: list[str]) -> list[Any]:
        """Return the parameters with these names, all for none."""
        found = await self._stored()
        return [self._shown(it.name, as_json(it.used)) for it in found.values() if not names or it.name in names]

    async def set_parameters(self, wanted: list[Any]) -> list[Any]:
        """Publish what is allowed; return the parameters as they are now."""
        found = {it.name: it for it in (await self._stored()).values()}
        for each in wanted:
            try:
                if not self._allow_write:
                    raise NotAllowed(f"{each.name}: start reem foxglove with --allow-write to set parameters")
                it = found[each.name]
                await publish(self.session, it.path, it.specification.checked(it.name, each.get_value()))
            except KeyError:
                self._refuse(f"no program has declared the parameter {each.name}")
            except (ReemError, RedisError, OSError) as error:
                self._refuse(str(error))
        return await self.parameters([each.name for each in wanted])

    def _refuse(self, text: str) -> None:
        self.bridge.server.publish_status(text, self._foxglove.StatusLevel.Error, "parameters")

    def subscribe_parameters(self, names: list[str], *, begin: bool) -> None:
        """Publish these parameters from now on when they change, or no more."""
        self._subscribed = self._subscribed | set(names) if begin else self._subscribed - set(names)


class LiveBridge(Bridge):
    """A bridge with parameters. Its owner is a `FoxgloveViewer`."""

    def _awaited(self, work: Any) -> Any:
        try:
            return asyncio.run_coroutine_threadsafe(work, self.owner.loop).result(_ANSWER)
        except (ReemError, RedisError, OSError, TimeoutError) as error:
            logger.warning("a request for parameters failed: %s", error)
            return []

    def on_get_parameters(self, client: Any, names: list[str], request: str | None = None) -> list[Any]:
        found: list[Any] = self._awaited(self.owner.parameters(names))
        return found

    def on_set_parameters(self, client: Any, parameters: list[Any], request: str | None = None) -> list[Any]:
        found: list[Any] = self._awaited(self.owner.set_parameters(parameters))
        return found

    def on_parameters_subscribe(self, names: list[str]) -> None:
        self.owner.loop.call_soon_threadsafe(lambda: self.owner.subscribe_parameters(names, begin=True))

    def on_parameters_unsubscribe(self, names: list[str]) -> None:
        self.owner.loop.call_soon_threadsafe(lambda: self.owner.subscribe_parameters(names, begin=False))
