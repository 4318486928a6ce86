"""The calls of callback subscribers."""

from __future__ import annotations

import _thread
import asyncio
import inspect
import logging
import sys
from collections.abc import Awaitable, Callable, Mapping
from contextvars import ContextVar, copy_context
from typing import TYPE_CHECKING, Any

from ..concurrency.queues import EMPTY, Ended
from ..concurrency.streams import Stream
from ..concurrency.tasks import is_being_cancelled, started
from ..concurrency.timeouts import forget
from ..errors import BadType, BadValue
from ..plan.paths import shorten

if TYPE_CHECKING:
    from .events import Update

logger = logging.getLogger("reem.subscribe")


_TOLD = frozenset(10**power for power in range(1, 12))  # numbers of equal exceptions that are worth a line in the log

_GIVEN = "data", "updated_path"  # the names of the first two arguments

_current_call: ContextVar[asyncio.Task[Any] | None] = ContextVar("_current_call", default=None)
"""The task that awaits the callback which this code belongs to; tasks that the callback starts inherit it."""


def arranged(function: Callable[..., Any], kwargs: Mapping[str, Any]) -> Callable[[Update], Any]:
    """Return what calls `function` for an update: data and path by name if it has these names, else in this order.

    It gets `kwargs` too, and the update if it has a parameter of that name or takes `**kwargs` without `*args`. Raises
    BadType if it cannot be called so.
    """
    try:
        signature = inspect.signature(function)
    except (TypeError, ValueError):  # of some functions written in C
        return lambda update: function(update.data, update.path, **kwargs)
    kinds = {each.kind for each in signature.parameters.values()}
    takes_any = inspect.Parameter.VAR_KEYWORD in kinds and inspect.Parameter.VAR_POSITIONAL not in kinds
    if "update" not in kwargs and (takes_any or "update" in signature.parameters):
        call = _in_this_way(function, signature, {**kwargs, "update": None})
        if call is not None:
            return lambda update: call(update.data, update.path, **kwargs, update=update)
    plain = _in_this_way(function, signature, kwargs)
    if plain is None:
        raise BadType(
            "callback_function cannot be called as "
            f"callback(data, updated_path{', ' * bool(kwargs)}{', '.join(kwargs)}): "
            f"it is {getattr(function, '__name__', type(function).__name__)}{signature}"
        )
    return lambda update: plain(update.data, update.path, **kwargs)


def _in_this_way(
    function: Callable[..., Any], signature: inspect.Signature, kwargs: Mapping[str, Any]
) -> Callable[..., Any] | None:
    """Return what calls `function` with data, path and `kwargs` in this order; None if it cannot be called."""
    parameters = signature.parameters.values()
    first = [each.name for each in parameters if each.kind in (each.POSITIONAL_ONLY, each.POSITIONAL_OR_KEYWORD)][:2]
    named = {each.name for each in parameters if each.kind in (each.POSITIONAL_OR_KEYWORD, each.KEYWORD_ONLY)}

    def takes(*values: Any, **names: Any) -> bool:
        try:
            signature.bind(*values, **names, **kwargs)
        except TypeError:
            return False
        return True

    # The order of these questions decides for functions that can be called in several ways: first as the manual says,
    # then by name as REEM 0.1 did, then with the two turned round.
    in_order, by_name = takes(None, None), takes(data=None, updated_path=None)
    if in_order and (first == [*_GIVEN] or not named.intersection(_GIVEN)):
        return function
    if by_name:
        return lambda data, path, **others: function(data=data, updated_path=path, **others)
    if in_order and ("data" in first[1:] or "updated_path" in first[:1]):
        return lambda data, path, **others: function(path, data, **others)
    return function if in_order else None


def checked_on_silent(function: Any, kwargs: Mapping[str, Any], ttl: float | None) -> Callable[[], Any]:
    """Return what calls `function` when silence begins; raises BadType or BadValue for what cannot be called so."""
    if function is None:
        return lambda: None
    if ttl is None:
        raise BadValue("on_silent is called when silence begins; say when that is, such as ttl=0.2")
    if not callable(function):
        raise BadType(f"on_silent={shorten(function)} is not a function; use one that is called with kwargs")
    try:
        inspect.signature(function).bind(**kwargs)
    except TypeError as error:
        raise BadType(f"on_silent is called as on_silent({', '.join(kwargs)}), with kwargs alone: {error}") from None
    except ValueError:  # of some functions written in C
        pass
    return lambda: function(**kwargs)


class Caller:
    def __init__(
        self, channel: str, function: Callable[[Update], Any], on_silent: Callable[[], Any] = lambda: None
    ) -> None:
        self._channel = channel
        self._function = function
        self._on_silent = on_silent
        self._raised: dict[object, int] = {}  # by kind and place
        self._dropped = 0

    def call(self, update: Update, dropped: int) -> Any:
        """Call the function, unless the update is only the value that was there already; log what it raises."""
        # Before the call, so that the log has the loss ahead of what it may cause.
        if dropped > self._dropped:
            self._dropped = dropped
            logger.warning(
                "%s: %d updates were skipped so far; newer ones came before the callback was done",
                self._channel,
                dropped,
            )
        if update.initial:
            return None
        try:
            return self._on_silent() if update.silent else self._function(update)
        except (Exception, asyncio.CancelledError):  # of something that was cancelled, and whose result it asked for
            self.failed(update)
            return None

    def call_on_thread(self, update: Update, dropped: int) -> None:
        """As `call`, on a thread of its own: nothing that the function raises ends the thread.

        A KeyboardInterrupt is also raised in the main thread.
        """
        try:
            self.call(update, dropped)
        except BaseException as error:
            self.failed(update)
            if isinstance(error, KeyboardInterrupt):
                _thread.interrupt_main()

    def failed(self, update: Update) -> None:
        """Log the exception that is being handled: of each kind the first, then only how many there were by now."""
        error, trace = sys.exc_info()[1:]
        while trace is not None and trace.tb_next is not None:
            trace = trace.tb_next
        # The innermost place, so that each of two mistakes in one callback has its first traceback in the log.
        kind = type(error), trace and (trace.tb_frame.f_code, trace.tb_lineno)
        count = self._raised[kind] = self._raised.get(kind, 0) + 1
        if count == 1:
            logger.exception("the callback for %s raised at %s; the subscription goes on", self._channel, update.path)
        elif count in _TOLD:
            logger.error("the callback for %s has raised %s %d times by now", self._channel, kind[0].__name__, count)

    def ended(self, reason: Exception) -> None:
        """Log the end of the calls if it is not by closing: the policy allowed no skipped update, for example."""
        if not isinstance(reason, Ended):
            logger.error("the callback for %s is not called any more: %s", self._channel, reason)


class Calls:
    def __init__(self, caller: Caller, updates: Stream[Update], kept: set[Any]) -> None:
        self.loop = asyncio.get_running_loop()
        self._caller = caller
        self._updates = updates
        self._kept = kept  # where to be as long as there may be calls
        self._busy = False
        self._awaited: asyncio.Task[Any] | None = None
        self._has_exited = False
        self._over = self.loop.create_future()
        self._context = copy_context()
        self._context.run(forget)  # a time limit given for listen() is not meant for what callbacks do
        kept.add(self)
        # What was put into the queue before this has woken no reader.
        updates.queue.wake = self._go_on
        self._go_on()

    def _go_on(self) -> None:
        if not self._busy and not self.loop.is_closed():
            self._busy = True
            self.loop.call_soon(self._call_waiting, context=self._context)

    def _call_waiting(self) -> None:
        queue, update = self._updates.queue, None
        try:
            # All that waits, in one turn of the loop: a task or a timer for each would cost more than the calls.
            while (update := queue.take()) is not EMPTY:
                result = self._caller.call(update, queue.dropped)
                if result is not None and inspect.isawaitable(result):
                    self._awaited = started(self._wait(update, result), "reem callback")
                    return
            self._busy = False
        except Exception as reason:
            self._caller.ended(reason)
            self._end()
        except BaseException as error:
            self._resume()
            if self._leaves(error):
                raise
            self._caller.failed(update)  # type: ignore[arg-type]  # only a call raises anything else

    async def _wait(self, update: Update, result: Awaitable[Any]) -> None:
        _current_call.set(asyncio.current_task())
        try:
            await result
        except (Exception, asyncio.CancelledError):
            if is_being_cancelled():
                self._end()
                raise
            self._caller.failed(update)
        except GeneratorExit:  # the event loop was closed
            raise
        except BaseException as error:
            if self._leaves(error):
                self.loop.call_soon(_raise, error)  # not as the result of this task, which nothing asks for
            else:
                self._caller.failed(update)
        self._resume()

    def _resume(self) -> None:
        self._busy = False
        self._go_on()

    def _leaves(self, error: BaseException) -> bool:
        """Return whether an exception leaves the event loop, as it would from any callback of asyncio.

        Of SystemExit only the first: later ones would break off what the program closes in the loop.
        """
        if isinstance(error, SystemExit):
            has_exited, self._has_exited = self._has_exited, True
            return not has_exited
        return isinstance(error, KeyboardInterrupt)

    def _end(self) -> None:
        self._kept.discard(self)
        self._updates.queue.wake = lambda: None
        if not self._over.done():
            self._over.set_result(None)

    async def done(self) -> None:
        """Wait until all calls were made. Returns at once in callbacks and their tasks: two may close each other."""
        caller = _current_call.get()
        if self.loop is asyncio.get_running_loop() and (caller is None or caller.done()):
            await asyncio.wait([self._over])


def _raise(error: BaseException) -> None:
    raise error
