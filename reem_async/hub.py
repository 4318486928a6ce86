"""The hub: the one subscription connection of an interface, kept alive for all that follow."""

from __future__ import annotations

import asyncio
import logging
import os
import random
import weakref
from typing import Any

from .background import in_background
from .errors import BadData, InterfaceClosed, RedisError
from .follow import Follower
from .plan.keys import Keys
from .plan.memory import Memory
from .plan.notices import decode
from .plan.paths import Path
from .ships.registry import Ships
from .transport.aio import AsyncTransport
from .transport.wire import Wire

__all__ = ["Hub"]

logger = logging.getLogger("reem.subscribe")


class Hub:
    """The one subscription connection of an interface in one event loop, and its followers by channel.

    Attributes:
        place: The process and the event loop it belongs to.
    """

    def __init__(self, transport: AsyncTransport, ships: Ships, memory: Memory) -> None:
        self._transport = transport
        self._ships = ships
        self._memory = memory
        self._wire: Wire | None = None
        self._channels: dict[bytes, weakref.WeakSet[Follower]] = {}
        self._subscribed: set[bytes] = set()
        self._lock = asyncio.Lock()
        self._reconnecting: asyncio.Task[Any] | None = None
        self._closed = False
        self._warned = False
        self.place = os.getpid(), asyncio.get_running_loop()

    def follower(self, keys: Keys, path: Path) -> Follower:
        """Return a follower of `path` that is not following yet."""
        return Follower(keys, path, self._ships, self._memory, self._transport)

    async def follow(self, follower: Follower) -> None:
        """Subscribe, then take the first snapshot; when this returns, no later update is missed."""
        self._transport.check()
        await self._ships.ready()
        channel = follower.keys.channel.encode()
        ready = follower.ready = asyncio.get_running_loop().create_future()
        try:
            async with self._lock:
                if ready.done():
                    ready.result()
                # Entered before the server confirms: a notice right behind the confirmation must find somebody.
                self._channels.setdefault(channel, weakref.WeakSet()).add(follower)
                wire = await self._connected()
                if channel not in self._subscribed:
                    await _subscribe(wire, [channel])
                    self._subscribed.add(channel)
                follower.start(wire, "initial")
            await ready
        except BaseException as error:
            self._drop(follower)
            if self._closed and isinstance(error, RedisError):
                raise InterfaceClosed("this RedisInterface was closed during the call") from None
            raise
        finally:
            follower.ready = None
            if ready.done() and not ready.cancelled():
                ready.exception()  # it was raised, or is overtaken by a cancellation

    async def _connected(self) -> Wire:
        """Return a live connection, with all channels subscribed and all followers started anew if it is new."""
        if self._closed:
            raise InterfaceClosed("this RedisInterface is closed; make a new one")
        if self._wire is not None and self._wire.alive:
            return self._wire
        wire = await self._transport.listen(self._on_push, self._on_lost)
        try:
            channels = [channel for channel, followers in self._channels.items() if followers]
            await _subscribe(wire, channels)
        except BaseException:
            await wire.close()
            raise
        self._wire, self._subscribed = wire, set(channels)
        for followers in list(self._channels.values()):
            for follower in list(followers):
                follower.start(wire, "gap")
        return wire

    async def unfollow(self, follower: Follower) -> None:
        """Stop following. Idempotent."""
        self._drop(follower)
        for mailbox in follower.mailboxes:
            mailbox.close()

    def _drop(self, follower: Follower) -> None:
        channel = follower.keys.channel.encode()
        follower.lost(InterfaceClosed("this subscription was closed before it began"))
        if follower in self._channels.get(channel, ()):
            self._channels[channel].discard(follower)
            self._forget_if_empty(channel)

    def _forget_if_empty(self, channel: bytes) -> None:
        if not self._channels.get(channel):
            self._channels.pop(channel, None)
            self._subscribed.discard(channel)
            if self._wire is not None and self._wire.alive:
                self._wire.send([("UNSUBSCRIBE", channel)], lambda _: None)

    def _on_push(self, message: list[Any]) -> None:
        channel, payload = message[-2:]
        followers = list(self._channels.get(channel, ()))
        if not followers:  # all were dropped without closing
            self._forget_if_empty(channel)
            return
        try:
            notice = decode(payload, self._ships)
        except BadData as error:
            if not self._warned:
                self._warned = True
                logger.warning("a message on %r could not be read: %s (said once)", channel, error)
            for follower in followers:
                follower.doubt()
            return
        for follower in followers:
            follower.on_notice(notice)

    def _on_lost(self, wire: Wire, reason: Exception) -> None:
        if wire is not self._wire:
            return
        self._subscribed.clear()
        for followers in self._channels.values():
            for follower in list(followers):
                follower.lost(reason)
        if not self._closed and self._reconnecting is None:
            logger.warning("the subscription connection was lost and is made again: %s", reason)
            self._reconnecting = in_background(self._reconnect(), "reem reconnect")

    async def _reconnect(self) -> None:
        """Connect, subscribe, and have every follower take a snapshot; tries until it works."""
        pause = 0.05
        try:
            while self._is_wanted():
                await asyncio.sleep(pause * random.uniform(0.5, 1.0))  # noqa: S311 - only spreads the load
                pause = min(pause * 2, 1.0)
                if not self._is_wanted():
                    return
                try:
                    async with self._lock:
                        await self._connected()
                except (RedisError, OSError) as error:
                    logger.debug("not connected yet: %s", error)
                except InterfaceClosed:
                    return
        finally:
            self._reconnecting = None

    def _is_wanted(self) -> bool:
        """Return whether somebody follows and the connection is gone."""
        followed = any(self._channels.values()) and not self._closed
        return followed and (self._wire is None or not self._wire.alive)

    async def close(self) -> None:
        """End all followers and the connection. Idempotent."""
        self._closed = True
        if self._reconnecting is not None:
            self._reconnecting.cancel()
        for followers in list(self._channels.values()):
            for follower in list(followers):
                await self.unfollow(follower)
        if self._wire is not None:
            await self._wire.close()


async def _subscribe(wire: Wire, channels: list[bytes]) -> None:
    """Subscribe and wait until the server has confirmed each channel."""
    for reply in await wire.roundtrip([("SUBSCRIBE", channel) for channel in channels]) if channels else []:
        if isinstance(reply, Exception):
            raise reply
