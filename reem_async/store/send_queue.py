"""Publishing that does not wait: calls queue their updates, and one background task sends them.

                 put (any thread)                    sender: one task, in the key's turn
    call  --------------------------->  queue  --------------------------------------->  server
           encode, number, own bytes   per key   oldest first, one transaction per call
      |
      +-- local="early": at once to the subscribers on this host that the sender has found

It is an outage that begins with the first call (`Outage`): the same queue, bounds and order. What differs:

- Calls put without the key's turn, which the sender holds for a round trip. They have a lock of their own, so their
  numbers are in the order of the queue.
- Updates have their numbers from the call on, as those of a publisher of its own (`PublisherIdentity`). Other stores
  of the interface may publish to the same key meanwhile.
- Updates of one place are merged only once some wait.
"""

from __future__ import annotations

import collections
import logging
import queue
import threading
import time
from collections.abc import Callable, Sequence
from typing import Any

from ..errors import BadType, BadValue, ConnectionLost, InterfaceClosed, Misuse, TlsRefused
from ..plan.keys import Keys
from ..session import PublisherIdentity, Session
from .document import Assignment, CallTime, DocumentWriter
from .outage import Kept, Outage, UnsentUpdates, own_copies, place_of, size_of

logger = logging.getLogger("reem.publish")

_POLICIES = ("raise", "drop", "newest")

LAG = 32  # calls of a key that wait before a further one replaces older ones of its place
MOST_CALLS = 1000  # calls that wait, of all keys together
_LONGEST_FINISH = 1.0  # seconds for which closing the interface, and the end of the program, wait for the queue
_IDLE = 5.0  # seconds without a call after which the sender's thread ends; the next call starts another one
# Seconds between two transactions of updates that subscribers on this host have already: one for each would cost
# publisher, server and subscribers two wake-ups each. Below the time from which a notice says that it is late.
_EARLY_REST = 0.005
_MOST_ERRORS = 100  # errors that wait to be reported
_PAUSE = 0.001  # seconds between two looks whether the sender has ended


def outages(
    session: Session, policy: str, wait: bool = True, on_error: Callable[[Exception], object] | None = None
) -> Outage | None:
    """Return what publishes with these choices of a PublishSpace; None for a call that waits and raises.

    Raises:
        BadValue, BadType: They mean nothing, or not together.
    """
    if policy not in _POLICIES:
        raise BadValue(f"outage={policy!r:.40}: use 'raise', 'drop' or 'newest'")
    if not isinstance(wait, bool):
        raise BadType(f"wait={wait!r:.40}: use True or False")
    if on_error is not None and not callable(on_error):
        raise BadType(f"on_error={on_error!r:.40} cannot be called: use a function that takes the error")
    if not wait:
        return SendQueue(session, policy, on_error)
    if on_error is not None:
        raise BadValue("on_error= is for wait=False: a call that waits raises its errors")
    return None if policy == "raise" else Outage(session, policy)


def _lags(out: UnsentUpdates) -> bool:
    return len(out.kept) + out.sending >= LAG


class SendQueue(Outage):
    """The queue of one PublishSpace with `wait=False`.

    Args:
        policy: What becomes of updates in an outage: "raise" drops them and reports the error.
        on_error: Called with each error, by the sender; without it, the next call raises the first one.
    """

    _task_name = "reem publish"

    def __init__(self, session: Session, policy: str, on_error: Callable[[Exception], object] | None) -> None:
        self._on_error = on_error
        self._rest = _EARLY_REST if session.local.early else 0.0
        super().__init__(session, policy)
        self.chosen = {"policy": policy, "wait": False, "on_error": on_error}

    def forget(self) -> None:
        super().forget()
        self._identity = PublisherIdentity(self._session.transport)
        self._session.activities.publishers.add(self._identity)
        self._replaced: dict[str, int] = {}  # by document: updates that calls dropped; the sender counts in `_dropped`
        self._errors: collections.deque[tuple[str, Exception]] = collections.deque(maxlen=_MOST_ERRORS)
        self._reporting = 0  # the thread that calls `on_error`
        self._is_idle = False  # the sender's thread waits for `_wakeups`, or is about to
        self._wakeups: queue.SimpleQueue[None] = queue.SimpleQueue()
        self._is_exit = False  # the program ends: calls send by themselves

    @property
    def dropped(self) -> int:
        return super().dropped + sum(list(self._replaced.values()))

    async def put(self, writer: DocumentWriter, assignments: Sequence[Assignment]) -> None:
        self._raise_earlier()
        called, own = CallTime(time.time(), time.monotonic()), own_copies(assignments)
        out = self._out.get(writer.keys.document)
        if out is not None and _lags(out):
            await self._session.transport.pause(0)  # let the sender go on, which may be a task of this event loop
        async with self._calls(writer.keys):
            self._session.transport.check()
            announcements = self._numbered(writer, own, called)
            self._put_kept(writer, Kept(own, size_of(own), called, announcements))
            for it, announcement in zip(own, announcements, strict=True):
                await announcement.share_early(it.path)
        await self._wake()

    def _numbered(self, writer: DocumentWriter, assignments: Sequence[Assignment], called: CallTime) -> tuple[Any, ...]:
        turn = writer.turn(self._identity)
        turn.called = called
        return tuple([turn.reserve(it.text, it.attachments, deleted=it.text is None) for it in assignments])

    def _put_kept(self, writer: DocumentWriter, it: Kept) -> None:
        document = writer.keys.document
        # First the sender asks whether the server is there: what is under way when a connection fails, or when an event
        # loop ends, is lost.
        state = self._session.transport.states.last.state
        away = self._reached != self._session.tasks.place or state != "connected"
        out = self._out.get(document) or self._out.setdefault(document, UnsentUpdates(writer, away=away))
        dropped = out.put(it, merge=self._is_outage or _lags(out))
        while len(out.kept) > 1 and self._is_full:  # the newest always stays
            dropped += out.drop_first()
        if dropped:
            self._replaced[document] = self._replaced.get(document, 0) + dropped
        if self._is_closed:  # by another thread, just now
            self._replaced[document] = self._replaced.get(document, 0) + out.drop_all()
            raise InterfaceClosed("this RedisInterface was closed during the call")

    @property
    def _is_full(self) -> bool:
        # One that is being sent is not counted, and more that share its transaction are.
        waiting = [len(out.kept) + max(out.sending - 1, 0) for out in list(self._out.values())]
        return sum(waiting) > MOST_CALLS or super()._is_full

    async def _wake(self) -> None:
        if self._is_idle:
            self._wakeups.put(None)
        if self._is_exit:
            # The sender has ended, except if the server did not answer it: then a call would wait for its turn.
            if not self._is_asking:
                await self._all_sent()
            return
        try:
            self._start_asking()
        except RuntimeError:  # the system has no more threads, or the interpreter is ending
            await self._all_sent()

    def _raise_earlier(self) -> None:
        """Raise the first error of earlier updates, once, unless there is a callback for errors."""
        if not self._errors or self._on_error is not None:
            return
        errors = list(self._errors)
        self._errors.clear()
        place, error = errors[0]
        more = f", the first of {len(errors)} errors" if len(errors) > 1 else ""
        error.add_note(f"this was an earlier update, of {place}{more}; the call that raises this has queued nothing")
        raise error.with_traceback(None)

    def _has_more(self) -> bool:
        """Wait for the next call, in the sender's thread; return whether there was one."""
        if self._asking is not True or self._is_closed or self._is_exit:  # a task of an event loop ends instead
            return False
        self._is_idle = True
        try:
            if not self._out:  # else a call has put something before it could know that this waits
                self._wakeups.get(timeout=_IDLE)
        except queue.Empty:
            return False
        finally:
            self._is_idle = False
        return True

    async def _all_sent(self) -> bool:
        every = await super()._all_sent()
        if not every:
            self._drop_for_outage()
        self._report()
        return every

    def _drop_for_outage(self) -> None:
        is_final = isinstance(self._reason, TlsRefused)  # does not end by waiting
        if self.policy == "newest" and not is_final:
            return
        dropped = []
        for out in list(self._out.values()):
            if (out.away or not self._session.transport.sharded) and (count := out.drop_all()):
                self._count(out.writer.keys, count)
                dropped.append(out.writer.name)
        if dropped and (self.policy == "raise" or is_final):
            self._errors.append((dropped[0], self._reason))

    def _not_stored(self, keys: Keys, it: Kept, error: BaseException, is_refused: bool) -> None:
        self._count(keys, len(it.assignments))
        if is_refused or (isinstance(error, ConnectionLost) and self.policy == "raise"):
            self._errors.append((place_of(keys, it), error))  # type: ignore[arg-type]

    def _report(self) -> None:
        if self._on_error is None:
            return
        self._reporting = threading.get_ident()
        try:
            while self._errors:
                place, error = self._errors.popleft()
                error.add_note(f"the update was one of {place}")
                try:
                    self._on_error(error)
                except Exception:
                    logger.exception("on_error raised")
        finally:
            self._reporting = 0

    async def flush(self, timeout: float | None = None) -> None:  # noqa: ASYNC109
        if self._reporting == threading.get_ident():
            raise Misuse("flush() in on_error would wait for itself: call it in another thread or task")
        await super().flush(timeout)
        self._raise_earlier()

    async def finish(self, *, is_exit: bool = False) -> None:
        """Wait for the queue, but not for long."""
        deadline = time.monotonic() + _LONGEST_FINISH
        if self._out:
            await self._is_sent_within(_LONGEST_FINISH)
        if is_exit:  # the sender's thread is a daemon, which may stop anywhere then
            self._is_exit = True
            self._wakeups.put(None)
            while self._is_asking and time.monotonic() < deadline:
                await self._session.transport.pause(_PAUSE)

    def close(self) -> None:
        super().close()
        self._wakeups.put(None)
        if self._errors and self._on_error is None:
            logger.warning("closed: %d errors were not reported; the first: %s", len(self._errors), self._errors[0][1])
