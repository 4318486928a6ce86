"""Makes the model's calls with REEM: with either front, from this thread or another one."""

from __future__ import annotations

import asyncio
import contextlib
import operator
import threading
from collections.abc import Callable, Coroutine
from concurrent.futures import Future, ThreadPoolExecutor
from typing import Any

import reem
import reem_async

from .inputs import dotted
from .model import Op, edited

LIMIT = 30.0
"""Seconds after which a call has not ended: all limits of REEM are far shorter."""


Address = tuple[str, dict[str, Any]]
"""A URL, and the options that go with it."""


class Client:
    """One interface with its two stores. Calls are made on the PublishSpace if they are to be `published`."""

    def __init__(self, label: str, address: Address, namespace: str) -> None:
        self.label, self.address, self.namespace = label, address, namespace


class Blocking(Client):
    def __init__(self, label: str, address: Address, namespace: str) -> None:
        super().__init__(label, address, namespace)
        self.open()

    def open(self) -> None:
        url, options = self.address
        self.interface = reem.RedisInterface(url, namespace=self.namespace, timeout=5, **options)
        self.kvs, self.space = reem.KeyValueStore(self.interface), reem.PublishSpace(self.interface)

    def perform(self, op: Op, published: bool) -> Any:
        """Make a call, by a method or by Python's own syntax: the length of the path says which."""
        store: Any = self.space if published else self.kvs
        if op.name == "get_dotted":
            return store.get(dotted(op.path))
        if op.name == "set_dotted":
            return store.set(dotted(op.path), op.value)
        if op.name == "contains":
            return op.path[0] in store
        holder = _holder(store, op)
        last, as_syntax = op.path[-1], len(op.path) % 2 == 0
        if as_syntax and op.name == "write":
            holder[last] = op.value
        elif as_syntax and op.name == "delete":
            del holder[last]
        elif as_syntax and op.name == "length":
            return len(holder[last])
        elif as_syntax and op.name in _SYNTAX and not isinstance(op.value, list):
            _SYNTAX[op.name](holder[last], op.value)
            return ...
        elif op.name in _OF_ELEMENTS:
            return _of_element(holder, op)
        elif op.name == "edit":
            with holder[last].edit() as value:
                edited(value, op.value)
        elif op.name == "entries":
            return sorted(holder[last].keys())
        else:
            return _method(holder[last], op)
        return None

    def keys(self) -> list[str]:
        return self.kvs.keys()

    def renew(self) -> None:
        self.interface.close()
        self.open()

    def close(self) -> None:
        self.interface.close()


_SYNTAX: dict[str, Callable[[Any, Any], Any]] = {
    "increment": operator.iadd,
    "decrement": operator.isub,
    "multiply": operator.imul,
    "divide": operator.itruediv,
    "extend": operator.iadd,
}


_OF_ELEMENTS = {"has": "contains", "pop": "pop", "setdefault": "setdefault"}
"""Calls that are made on what holds the place."""


def _holder(store: Any, op: Op) -> Any:
    for key in op.path[:-1]:
        store = store[key]
    return store


def _of_element(holder: Any, op: Op) -> Any:
    method = getattr(holder, _OF_ELEMENTS[op.name])
    return method(op.path[-1], op.value) if op.name == "setdefault" else method(op.path[-1])


def _method(place: Any, op: Op) -> Any:
    method = getattr(place, op.name)
    return method() if op.name in ("read", "delete", "length", "type") else method(op.value)


class Elsewhere(Client):
    """A blocking client, whose calls are made on another thread."""

    def __init__(self, inner: Blocking) -> None:
        super().__init__(f"{inner.label} on a thread", inner.address, inner.namespace)
        self.inner, self.pool = inner, ThreadPoolExecutor(1)

    def perform(self, op: Op, published: bool) -> Any:
        return self.pool.submit(self.inner.perform, op, published).result(LIMIT)

    def keys(self) -> list[str]:
        return self.inner.keys()

    def close(self) -> None:
        self.pool.shutdown()


class Asyncio(Client):
    """The asyncio front, in an event loop on a thread of its own."""

    def __init__(self, label: str, address: Address, namespace: str) -> None:
        super().__init__(label, address, namespace)
        self.loop = asyncio.new_event_loop()
        self.thread = threading.Thread(target=self.loop.run_forever, daemon=True)
        self.thread.start()
        self.run(self._open())

    async def _open(self) -> None:
        url, options = self.address
        self.interface = reem_async.RedisInterface(url, namespace=self.namespace, timeout=5, **options)
        self.kvs, self.space = reem_async.KeyValueStore(self.interface), reem_async.PublishSpace(self.interface)

    def begin(self, coroutine: Coroutine[Any, Any, Any]) -> Future[Any]:
        return asyncio.run_coroutine_threadsafe(coroutine, self.loop)

    def run(self, coroutine: Coroutine[Any, Any, Any]) -> Any:
        return self.begin(coroutine).result(LIMIT)

    def perform(self, op: Op, published: bool) -> Any:
        return self.run(self.call(op, published))

    async def call(self, op: Op, published: bool) -> Any:
        store: Any = self.space if published else self.kvs
        if op.name == "get_dotted":
            return await store.get(dotted(op.path))
        if op.name == "set_dotted":
            return await store.set(dotted(op.path), op.value)
        if op.name == "contains":
            return await store.contains(op.path[0])
        place = store
        for key in op.path:
            place = place[key]
        if op.name in _OF_ELEMENTS:
            return await _of_element(_holder(store, op), op)
        if op.name == "entries":
            return sorted(await place.keys())
        if op.name != "edit":
            return await _method(place, op)
        async with place.edit() as value:
            edited(value, op.value)
        return None

    def cancelled(self, op: Op, published: bool, turns: int, seconds: float) -> bool:
        """Make a call in a task, and cancel it some turns of the loop, or seconds, later; returns whether it was."""

        async def run() -> bool:
            task = asyncio.ensure_future(self.call(op, published))
            for _ in range(turns):
                await asyncio.sleep(0)
            if seconds:
                await asyncio.sleep(seconds)
            task.cancel()
            try:
                await task
            except asyncio.CancelledError:
                return True
            return False

        return bool(self.run(run()))

    def keys(self) -> list[str]:
        return list(self.run(self.kvs.keys()))

    def renew(self) -> None:
        self.run(self.interface.close())
        self.run(self._open())

    def close(self) -> None:
        with contextlib.suppress(Exception):
            self.run(self.interface.close())
        self.loop.call_soon_threadsafe(self.loop.stop)
        self.thread.join(LIMIT)
