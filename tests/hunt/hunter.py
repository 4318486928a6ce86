"""Takes random steps with REEM and with the model, and stops at the first difference."""

from __future__ import annotations

import collections
import contextlib
import copy
import faulthandler
import random
import time
import zlib
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import numpy as np
from chaos.proxy import Proxy

from reem_async.errors import ConnectionLost, InterfaceClosed, NotConnected, Overflow, PartialWrite, ReemError
from reem_async.server import EmbeddedServer

from . import faults
from .checks import Follower, Server, check_recording, check_snapshot, compare, same
from .clients import Asyncio, Blocking, Client, Elsewhere
from .inputs import BAD_TOPS, NAMESPACES, TOPS, Inputs, dotted
from .model import ABSENT, ANSWERING, CHANGES, READS, Expected, Op, as_read, expected
from .secured import secured

STUCK = 120.0
REST, WHOLE, FOLLOW = 150, 1500, 40
"""After how many steps all is compared, a snapshot and a recording are made, and followers come and go."""
MOST_FOLLOWERS = 6
HISTORY = 15
_LOST = (ConnectionLost, NotConnected, PartialWrite)


class Difference(AssertionError):
    """REEM did not do what the model did."""


class Hunter:
    """One hunt.

    Args:
        seed: What all chance comes from.
        share: The part of the steps that are broken off.
        secured: Use TLS, and a user with no more rights than deploy/users.acl gives.
        plain: Use servers without the JSON module.
    """

    def __init__(self, seed: int, share: float, *, secured: bool = False, plain: bool = False) -> None:
        self.share, self.secured, self.plain = share, secured, plain
        self.rng = random.Random(seed)
        self.inputs = Inputs(self.rng)
        self.documents: dict[str, Any] = {}
        self.history: dict[str, collections.deque[str]] = {}
        self.counts: collections.Counter[str] = collections.Counter()
        self.broken: set[str] = set()
        self.followers: list[Follower] = []
        self.steps = 0
        self.doing = ""

    def run(self, seconds: float, steps: int = 0) -> None:
        """Take steps for some time, or as many as given; raises Difference."""
        with contextlib.ExitStack() as stack:
            self._open(stack)
            until = time.monotonic() + seconds
            while self.steps < steps if steps else time.monotonic() < until:
                faulthandler.dump_traceback_later(STUCK, exit=True)
                try:
                    self._step()
                except Difference:
                    raise
                except Exception as error:
                    raise Difference(
                        f"{self.doing}: {type(error).__name__}: {error}{self._told(self.doing)}"
                    ) from error
            self._guarded("at the end", self._whole)
            self._drop_followers(0)
            faulthandler.cancel_dump_traceback_later()

    def _open(self, stack: contextlib.ExitStack) -> None:
        made = [stack.enter_context(EmbeddedServer(json=not self.plain)) for _ in range(2)]
        self.here, self.there = (Server(server.url, json=server.json) for server in made)
        at = secured(stack, self.here) if self.secured else (self.here.url, {})
        main, spaced = Blocking("blocking", at, ""), Blocking("blocking r:", at, NAMESPACES[1])
        self.blocking: list[Blocking] = [main, spaced, Blocking("blocking r:一.", at, NAMESPACES[2])]
        self.asyncio = [Asyncio("asyncio", at, ""), Asyncio("asyncio r:", at, NAMESPACES[1])]
        self.clients: list[Client] = [*self.blocking, Elsewhere(main), Elsewhere(spaced), *self.asyncio]
        self.ears = Blocking("ears", at, ""), Asyncio("ears of asyncio", at, "")
        self.proxy = stack.enter_context(Proxy(int(self.here.url.rpartition(":")[2])))
        far = (self.proxy.url, {})
        self.far: list[Client] = [Blocking("far", far, ""), Asyncio("far asyncio", far, "")]
        for client in (*self.ears, *self.clients, *self.far):
            stack.callback(client.close)

    # --- steps ---

    def _step(self) -> None:
        self.steps += 1
        if self.steps % FOLLOW == 0:
            self._guarded("following", self._follow)
        if self.steps % REST == 0:
            self._guarded("at rest", self._rest)
        if self.steps % WHOLE == 0:
            self._guarded("the whole", self._whole)
        kind = self.rng.random()
        if kind < self.share:
            self._fault()
        elif kind < self.share + 0.01:
            self._crowd()
        elif kind < self.share + 0.02:
            self._together()
        elif kind < self.share + 0.03:
            self._list_keys()
        else:
            client = self.rng.choice(self.clients)
            self._take(client, *self._choose(client))

    def _choose(self, client: Client, names: tuple[str, ...] = READS + CHANGES + ("write",) * 5) -> tuple[Op, str]:
        if self.rng.random() < 0.01:
            return self.inputs.op(self.rng.choice(BAD_TOPS), ABSENT, names), ""
        top = self.rng.choice(TOPS[:4] if self.rng.random() < 0.3 else TOPS)
        full = client.namespace + top
        document = self.documents.get(full, ABSENT)
        op = self.inputs.op(top, document, names)
        if _size(document) > 60:  # documents do not grow for ever
            op = self.rng.choice([Op("delete", (top,)), Op("write", (top,), self.inputs.value())])
        return op, full

    def _publishes(self, full: str, op: Op) -> bool:
        """Return whether the call is one of the PublishSpace: some keys are only ever published, and mirrored."""
        return _published(full) and (op.name in CHANGES or zlib.crc32(repr(op.path).encode()) % 20 == 0)

    def _expect(self, client: Client, op: Op, full: str) -> Expected:
        write_only = self._publishes(full, op)
        return expected(self.documents.get(full, ABSENT), op, client.namespace, write_only=write_only)

    def _take(self, client: Client, op: Op, full: str, how: str = "") -> None:
        """Make a call with both, and compare what comes of it."""
        due = self._expect(client, op, full)
        self._note(full, f"{client.label}{how}: {op!r}")
        self.counts[op.name] += 1
        self._perform(client, op, full, due)
        self._became(full, due.after)

    def _perform(self, client: Client, op: Op, full: str, due: Expected) -> None:
        """Make a call, and compare what it returns or raises."""
        try:
            result = client.perform(op, self._publishes(full, op))
        except Exception as error:
            if due.error is None or not isinstance(error, due.error):
                wanted = f"{due.error}" if due.error else f"{due.result!r:.500}"
                raise Difference(f"{op!r} raised {error!r:.500}, due: {wanted}{self._told(full)}") from error
            text = str(error)
            if isinstance(error, ReemError) and op.path[0] == "pose" and ("pose" not in text or len(text) > 1000):
                raise Difference(f"{op!r}: the message is too long or does not name the key: {text:.1200}") from error
            return
        if due.error is not None:
            raise Difference(f"{op!r} brought {result!r:.500}, due: {due.error}{self._told(full)}")
        if result is ... or op.name not in ANSWERING:
            return
        if op.name == "setdefault":
            result = as_read(result)
        if result is not due.result and not same(result, due.result):
            raise Difference(f"{op!r} brought {result!r:.900}, due: {due.result!r:.900}{self._told(full)}")

    def _became(self, full: str, document: Any) -> None:
        if document is ABSENT:
            self.documents.pop(full, None)
        else:
            self.documents[full] = document

    def _list_keys(self) -> None:
        client = self.rng.choice(self.clients)
        self.doing = ""
        start = client.namespace
        due = sorted(name[len(start) :] for name in self.documents if name.startswith(start) and name != start)
        keys = client.keys()
        self.counts["keys"] += 1
        if keys != due:
            raise Difference(f"keys() of {client.label} differ by {set(keys) ^ set(due)}: {keys}")

    # --- several at once, where what comes of it is certain all the same ---

    def _crowd(self) -> None:
        """Let some clients call at once, each on a key of its own."""
        self.counts["crowd"] += 1
        clients = self.rng.sample([self.blocking[0], self.blocking[1], *self.asyncio], 3)
        crowd = {client.namespace + self.rng.choice(TOPS): (client, self.rng.random()) for client in clients}
        with ThreadPoolExecutor() as pool:
            list(pool.map(self._crowded, crowd, *zip(*crowd.values(), strict=True)))

    def _crowded(self, full: str, client: Client, seed: float) -> None:
        inputs = Inputs(random.Random(seed))
        for _ in range(8):
            top = full[len(client.namespace) :]
            op = inputs.op(top, self.documents.get(full, ABSENT))
            self._take(client, op, full, " in a crowd")

    def _together(self) -> None:
        """Let some clients count, append, and put arrays into one document at once: nothing is lost."""
        self.counts["together"] += 1
        full = "together"
        clients = [self.blocking[0], Blocking("another", self.blocking[0].address, ""), self.asyncio[0]]
        start = {"n": 0, "list": [], "a": {str(number): None for number in range(3)}}
        self._take(clients[0], Op("write", (full,), start), full)

        def work(number: int, client: Client) -> None:
            place = (full, "a", str(number))
            for count in range(5):
                client.perform(Op("increment", (full, "n"), 1), _published(full))
                client.perform(Op("append", (full, "list"), [number, count, np.arange(count)]), _published(full))
                client.perform(Op("write", place, [np.full(count, number), {"x": np.arange(3)}]), _published(full))
                client.perform(Op("write", place, {"x": np.arange(count)}), _published(full))

        try:
            with contextlib.closing(clients[1]), ThreadPoolExecutor() as pool:
                list(pool.map(work, range(3), clients))
        except Exception as error:
            raise Difference(f"together: {error!r}") from error
        stored = clients[0].perform(Op("read", (full,)), False)
        items = [[number, count, np.arange(count)] for number in range(3) for count in range(5)]
        compare(sorted(stored["list"], key=lambda item: item[:2]), items, "what was appended together")
        due = {"n": 15, "list": stored["list"], "a": {str(number): {"x": np.arange(4)} for number in range(3)}}
        compare(stored, due, "what was written together")
        self._became(full, due)

    # --- calls that are broken off ---

    def _fault(self) -> None:
        usual = [self._interrupt, self._cancel, self._cut]
        fault = self.rng.choice([*usual, *usual, self._close])
        if self.rng.random() < 0.03:
            fault = self._fork
        self.counts[fault.__name__[1:]] += 1
        fault()

    def _interrupt(self) -> None:
        client = self.rng.choice(self.blocking)
        op, full = self._choose(client)
        self._broken_off(client, op, full, lambda make: faults.interrupted(self.rng, make), KeyboardInterrupt)

    def _close(self) -> None:
        client = self.rng.choice(self.blocking)
        op, full = self._choose(client)
        close = client.interface.close
        self._broken_off(client, op, full, lambda make: faults.handled(self.rng, make, close), InterfaceClosed)
        client.renew()
        if full and op.name in CHANGES:  # what a call has left that was broken off goes with the next write there
            document = self.documents.get(full, ABSENT)
            self._take(client, Op("write", (op.path[0],), copy.deepcopy({} if document is ABSENT else document)), full)

    def _cut(self) -> None:
        client = self.rng.choice(self.far)
        op, full = self._choose(client)
        self._broken_off(client, op, full, lambda make: faults.cut(self.rng, self.proxy, make), _LOST)

    def _broken_off(
        self,
        client: Client,
        op: Op,
        full: str,
        run: Callable[[Callable[[], None]], Any],
        error: type[BaseException] | tuple[type[BaseException], ...],
    ) -> None:
        due = self._expect(client, op, full)
        self._note(full, f"{client.label}, {error}: {op!r}")
        try:
            run(lambda: self._perform(client, op, full, due))
        except error as raised:
            self._settle(client, full, due, raised)
        except Difference as raised:
            if not isinstance(raised.__cause__, error):
                raise
            self._settle(client, full, due, raised.__cause__)
        else:
            self._became(full, due.after)

    def _cancel(self) -> None:
        client = self.rng.choice(self.asyncio)
        op, full = self._choose(client)
        due = self._expect(client, op, full)
        self._note(full, f"{client.label}, cancelled: {op!r}")
        try:
            was = faults.cancelled(self.rng, client, op, self._publishes(full, op))
        except Exception as error:
            if due.error is None or not isinstance(error, due.error):
                raise Difference(f"{op!r}, cancelled, raised {error!r:.500}{self._told(full)}") from error
            return
        if was:
            self._settle(client, full, due)
        elif due.error is not None:
            raise Difference(f"{op!r} came to an end, due: {due.error}{self._told(full)}")
        else:
            self._became(full, due.after)

    def _settle(self, client: Client, full: str, due: Expected, raised: BaseException | None = None) -> None:
        """See what became of a call: NotConnected means not applied, PartialWrite applied, all else one of both."""
        self.counts["broken off"] += 1
        before = self.documents.get(full, ABSENT)
        self.broken.add(full)
        if not full:
            return
        self._clean(client, full)
        if due.error is Overflow:  # docs/guarantees.md, 5: the server may have calculated, and nobody put it right
            document = {} if before is ABSENT else before
            self._take(self.ears[0], Op("write", (full,), copy.deepcopy(document)), full)
            return
        self.here.settle()
        stored = self.ears[0].kvs.get(dotted((full,)) or "", ABSENT) if dotted((full,)) else self._stored(full)
        if same(stored, due.after) and (same(before, due.after) or not isinstance(raised, NotConnected)):
            self.counts["applied"] += 1
            self._became(full, due.after)
        elif not same(stored, before) or isinstance(raised, PartialWrite):
            raise Difference(
                f"broken off by {raised!r:.300}: {stored!r:.900}\n"
                f"of {before!r:.900}\nand {due.after!r:.900}{self._told(full)}"
            )

    def _clean(self, client: Client, full: str) -> None:
        """Have a client wait for what is still on its way to a key, and remove arrays that a call left there."""
        for _ in range(4):  # each of its connections may be dead
            try:
                client.perform(Op("delete", (full[len(client.namespace) :], "never there"), None), False)
            except _LOST:
                continue
            except ReemError:
                return

    def _stored(self, full: str) -> Any:
        kvs = self.ears[0].kvs
        return kvs[full].read() if full in kvs else ABSENT

    def _fork(self) -> None:
        """Let a forked child call, and this process meanwhile."""
        client = self.rng.choice(self.blocking)
        op, full = self._choose(client)
        other, name = self._choose(client)
        if name == full:
            return
        due = self._expect(client, op, full)
        self._note(full, f"{client.label}, in a fork: {op!r}")
        wrong = faults.in_a_fork(
            client,
            lambda child: self._perform(child, op, full, due),
            lambda: self._take(client, other, name, " beside a fork"),
        )
        if wrong:
            raise Difference(f"in a fork: {wrong}{self._told(full)}")
        self._became(full, due.after)

    # --- comparing ---

    def _guarded(self, what: str, check: Callable[[], None]) -> None:
        try:
            check()
        except AssertionError as error:
            names = [name for name in self.history if repr(name) in str(error) or f"{{{name}}}" in str(error)]
            raise Difference(f"{what}: {error}" + "".join(map(self._told, names[:2]))) from error

    def _rest(self) -> None:
        self.counts["compared"] += 1
        self.doing = ""
        self.here.settle()
        self.here.check(self.documents)
        if self.secured:
            denied = [(row["reason"], row["object"]) for row in self.here.raw.acl_log()]
            assert not denied, f"the server refused {denied}"
        for name, document in self.documents.items():
            compare(self._stored(name), document, f"{name!r}")
        for follower in self.followers:
            exact = follower.name not in self.broken
            follower.check(self.documents.get(follower.name, ABSENT), exact=exact)

    def _whole(self) -> None:
        self._rest()
        self.counts["snapshots"] += 1
        check_snapshot(self.here, self.there, self.documents)
        self.counts["recordings"] += 1
        check_recording(self.here, self.there, self.documents, self._publish_some)

    def _publish_some(self) -> None:
        share, self.share = self.share, 0.0
        for _ in range(40):
            client = self.rng.choice(self.clients)
            op, full = self._choose(client, CHANGES)
            if _published(full):
                self._take(client, op, full, " while it is recorded")
        self.share = share

    def _follow(self) -> None:
        self._drop_followers(self.rng.randrange(MOST_FOLLOWERS))
        some = [self.rng.choice(NAMESPACES[:2]) + self.rng.choice(TOPS) for _ in range(10)]
        names = [name for name in some if _published(name) and dotted((name,))]
        for name in names[: MOST_FOLLOWERS - len(self.followers)]:
            self.counts["followed"] += 1
            below = self.inputs.path(self.documents.get(name, ABSENT)) if self.rng.random() < 0.5 else ()
            path = below if dotted((name, *below)) else ()
            self.followers.append(
                Follower(name, path, self.documents.get(name, ABSENT), self.ears[0].interface, self.ears[1])
            )

    def _drop_followers(self, left: int) -> None:
        while len(self.followers) > left:
            self.followers.pop(0).close()

    def _note(self, full: str, text: str) -> None:
        self.doing = full
        self.history.setdefault(full, collections.deque(maxlen=HISTORY)).append(f"{self.steps}: {text}")

    def _told(self, full: str) -> str:
        return f"\nlast done to {full!r}:\n  " + "\n  ".join(self.history.get(full, ()))


def _published(full: str) -> bool:
    """Return whether a key is only ever published: its name decides."""
    return zlib.crc32(full.encode()) % 2 == 0 if full else False


def _size(tree: Any) -> int:
    """Return how many values a document holds."""
    items = tree.values() if isinstance(tree, dict) else tree if isinstance(tree, list) else ()
    return 1 + sum(map(_size, items))
