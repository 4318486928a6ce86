"""A recording that Foxglove plays, at the pace and from the instant that a client asks for."""

from __future__ import annotations

import heapq
import queue
import time
from collections import Counter
from collections.abc import Iterator, Sequence
from contextlib import suppress
from operator import itemgetter
from typing import Any

from ...concurrency.tasks import come_last
from ...errors import BadValue
from ...plan.trees import MISSING
from ..recording.log import Log
from ..recording.times import nanoseconds
from .base import TICK, extra, top_patterns
from .foxglove import Bridge
from .topics import Topics

_FASTEST = 100.0  # times the recorded pace
_LONGEST_TURN = 0.1  # seconds of sending until the requests of clients are looked at again


class FoxglovePlayer:
    """A recording, played to Foxglove as its clients wish; it begins when the first one subscribes to something.

    Args:
        log: The recording; it is not closed.
        patterns: Globs of top-level keys; all if there is none.
        host: Where to listen.
        port: The port; 0 for a free one.
        rate: Messages a second of each array and picture, at most.
    """

    def __init__(
        self, log: Log, patterns: Sequence[str] = (), *, host: str = "127.0.0.1", port: int = 8765, rate: float = 30.0
    ) -> None:
        come_last()
        self._foxglove: Any = extra("foxglove", "foxglove-sdk")
        self._log = log.raw  # pictures are passed on as they are
        tops = top_patterns(patterns)
        self._names = {name for name in log.names() if any(each.concerns((name,)) for each in tops)}
        if not self._names:
            raise BadValue(f"nothing is played of {', '.join(patterns)}; recorded are {', '.join(log.names()):.200}")
        self.skipped: Counter[str] = Counter()
        self._topics = Topics(self._foxglove, rate, self.skipped)
        self._requests: queue.SimpleQueue[Any] = queue.SimpleQueue()
        self._coming: Iterator[tuple[float, str, Any]] = iter(())
        self._next: tuple[float, str, Any] | None = None
        self._wanted: set[str] = set()
        self._position, self._speed, self._playing, self._begun = log.start, 1.0, False, False
        self._then = time.monotonic()  # when the position was last moved
        span = nanoseconds(log.start), nanoseconds(log.end)
        capabilities = [self._foxglove.Capability.PlaybackControl, self._foxglove.Capability.Time]
        options = {"capabilities": capabilities, "playback_time_range": span}
        self.bridge = PlayerBridge(self, log.path.name, host, port, self._topics, self._foxglove, options)

    def run(self) -> None:
        """Play until an exception ends it, such as KeyboardInterrupt."""
        try:
            self._advertise()
            while True:
                began = time.monotonic()
                self._take_requests()
                self._choose()
                if self._playing:
                    self._advance()
                self._topics.tick()
                time.sleep(max(TICK, time.monotonic() - began))
        finally:
            self.bridge.server.stop()

    def _advertise(self) -> None:
        """Offer what there was at the beginning and at the end of each key."""
        for name in sorted(self._names):
            first = next((tree for _, tree in self._log.states(name, self._log.start - 1)), MISSING)
            for tree in (first, self._log.tree_at(self._log.end).get(name, MISSING)):
                if tree is not MISSING:
                    self._topics.show(name, tree, nanoseconds(self._log.start))

    def _choose(self) -> None:
        """Read the keys that clients want, from now on."""
        wanted = {name for name in self._names if self._topics.wants(name) is not None}
        if wanted == self._wanted:
            return
        new, self._wanted = wanted - self._wanted, wanted
        if not self._begun:
            self._begun = self._playing = True
            self._then = time.monotonic()
            self._broadcast()
        self._read_from(self._position, new)

    def _read_from(self, position: float, names: set[str]) -> None:
        """Show what these keys held at a position, and continue behind it with all that are wanted."""
        trees = self._log.tree_at(position) if names else {}
        for name in sorted(names & trees.keys()):
            self._topics.show(name, trees[name], nanoseconds(position))
        streams = [self._named(name, position) for name in sorted(self._wanted)]
        self._coming = heapq.merge(*streams, key=itemgetter(0))
        self._next = next(self._coming, None)

    def _named(self, name: str, after: float) -> Iterator[tuple[float, str, Any]]:
        for instant, tree in self._log.states(name, after):
            yield instant, name, tree

    def _advance(self) -> None:
        now = time.monotonic()
        self._position += (now - self._then) * self._speed
        self._then = now
        while self._next is not None and self._next[0] <= self._position:
            instant, name, tree = self._next
            if time.monotonic() > now + _LONGEST_TURN:  # this machine cannot play so fast: the position waits
                self._position = instant
                break
            if tree is not MISSING:
                self._topics.show(name, tree, nanoseconds(instant))
            self._next = next(self._coming, None)
        if self._position >= self._log.end:
            self._position, self._playing = self._log.end, False
            self._broadcast()
        self.bridge.server.broadcast_time(nanoseconds(self._position))

    # What clients ask for.

    def request(self, request: Any) -> Any:
        """Return the state that a request leads to; it is obeyed a moment later. Any thread may."""
        position = self._position
        if request.seek_time is not None:
            position = min(max(request.seek_time / 1e9, self._log.start), self._log.end)
        speed = request.playback_speed if 0 < request.playback_speed <= _FASTEST else self._speed
        playing = request.playback_command == self._foxglove.websocket.PlaybackCommand.Play
        self._requests.put((playing, speed, None if request.seek_time is None else position))
        return self._state(playing, position, speed, request.seek_time is not None, request.request_id)

    def _take_requests(self) -> None:
        with suppress(queue.Empty):
            while True:
                playing, self._speed, seek = self._requests.get_nowait()
                if playing and not self._playing:
                    self._then = time.monotonic()
                if playing and seek is None and self._position >= self._log.end:
                    seek = self._log.start  # at the end, Play begins again
                self._playing, self._begun = playing, True
                if seek is not None:
                    self._position, self._then = seek, time.monotonic()
                    self._read_from(seek, self._wanted)
                    self.bridge.server.broadcast_time(nanoseconds(seek))

    def _state(self, playing: bool, position: float, speed: float, seeks: bool, request: str | None) -> Any:
        status = self._foxglove.websocket.PlaybackStatus
        is_at_end = not playing and position >= self._log.end
        return self._foxglove.websocket.PlaybackState(
            status=status.Playing if playing else status.Ended if is_at_end else status.Paused,
            current_time=nanoseconds(position),
            playback_speed=speed,
            did_seek=seeks,
            request_id=request,
        )

    def _broadcast(self) -> None:
        state = self._state(self._playing, self._position, self._speed, False, None)
        self.bridge.server.broadcast_playback_state(state)


class PlayerBridge(Bridge):
    """A bridge with playback controls. Its owner is a player."""

    def on_playback_control_request(self, playback_control_request: Any) -> Any:
        return self.owner.request(playback_control_request)
