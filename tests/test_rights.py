"""Users who lack one right: each call is refused and does nothing, or is done, or says what of it was done."""

import collections
import contextlib
import random
import re

import pytest
import redis
from callkit import CALLS
from clusterkit import assert_tidy, clients_of
from conftest import PLAIN, assert_same, sized

import reem_async
from reem_async.errors import MissingKey, NotAllowed, PartialWrite, PathRefused, RedisError
from reem_async.server import EmbeddedServer
from reem_async.server.cluster import EmbeddedCluster

LOGIN = "ping hello auth select info client|setinfo cluster|slots"
"""Without one of these there is no connection."""
COMMANDS = (
    "json.set json.get json.del json.type json.numincrby json.nummultby json.arrappend json.arrlen json.objlen "
    "set get unlink rename persist type scan sadd srem smembers multi exec discard watch unwatch publish"
)
if PLAIN:
    COMMANDS = "getrange " + re.sub(r"json\.\w+ ", "", COMMANDS)
SHARDED = "spublish asking"
PATTERNS = {"~robot1:*", "~{robot1:*", "&{robot1:*}:notices", "&{robot1:*}:notices@*"}
OWN = "~elsewhere"
"""Something that every user may, so that no rule is empty."""


class Rights:
    """A server, or the nodes of a cluster, with a user who has all rights but one."""

    def __init__(self, host, clients):
        self.host, self.clients = host, clients
        self.all = [*COMMANDS.split(), *(SHARDED.split() if len(clients) > 1 else ()), *PATTERNS]

    def give(self, lacking=None):
        """Let the user have all rights but the one it lacks."""
        rights = [each if each[0] in "~&" else f"+{each}" for each in self.all if each != lacking]
        login = [f"+{each}" for each in LOGIN.split()]
        rule = ["on", ">pw", "resetkeys", OWN, "resetchannels", "-@all", *login, *rights]
        for client in self.clients:
            client.execute_command("ACL", "SETUSER", "robot", *rule)

    def used(self):
        """Return which of the rights have been used since the last call; all patterns are."""
        found = set()
        for client in self.clients:
            found |= {name.removeprefix("cmdstat_") for name in client.info("commandstats")}
            client.execute_command("CONFIG", "RESETSTAT")
        return {each for each in self.all if each in found or each[0] in "~&"}

    def log_in(self):
        return reem_async.RedisInterface(self.host, namespace="robot1:", username="robot", password="pw")

    def note(self, name):
        for client in self.clients:
            with contextlib.suppress(redis.exceptions.RedisError):
                return client.get("{robot1:" + name + "}:last")
        return None


@pytest.fixture(scope="module")
def single():
    with EmbeddedServer() as server, clients_of([server]) as clients:
        yield Rights(f"redis://127.0.0.1:{server.port}", clients)


@pytest.fixture(scope="module")
def several():
    with EmbeddedCluster(primaries=3, replicas=0) as cluster, clients_of(cluster.nodes) as clients:
        yield Rights(cluster.url, clients)


@contextlib.asynccontextmanager
async def _closing(interface):
    try:
        yield interface
    finally:
        await interface.close()


class Trial:
    """One call of a user who lacks a right."""

    def __init__(self, rights, admin, name, space, kind):
        self.rights, self.admin, self.name, self.space, self.kind = rights, admin, name, space, kind
        self.before, self._call, self.after = CALLS[kind]

    async def run(self, lacking, *, late):
        """Make the call; with `late`, the right is taken away after the interface has made another one."""
        self.lacking = lacking
        self.rights.give(None if late else lacking)
        await self.admin[self.name].write(self.before)
        async with _closing(self.rights.log_in()) as interface:
            at = getattr(reem_async, self.space)(interface)[self.name]
            if late:
                await at.write(self.before)
                self.rights.give(lacking)
            self._noted = self.rights.note(self.name)
            self.told = None
            try:
                await self._call(at)
            except (RedisError, PathRefused) as error:
                self.told = error

    async def check(self):
        about = (self.space, self.kind, self.lacking, self.told)
        if isinstance(self.told, PartialWrite):
            written = self.after is not PathRefused and "not written" not in str(self.told)
            await self._is(self.after if written else self.before, about)
            await self.admin[self.name].write(0)
        elif isinstance(self.told, NotAllowed):
            assert self._names_it(), about
            # What the server refuses for its place is told, and then told otherwise, before the reason is asked for.
            assert self.after is PathRefused or self.rights.note(self.name) == self._noted, about
            await self._is(self.before, about)
        else:
            assert self.told is None or (self.after is PathRefused and isinstance(self.told, PathRefused)), about
            await self._is(self.after if self.told is None else self.before, about)
            if self.lacking == (
                "get" if PLAIN else "json.get"
            ):  # whoever may not read leaves arrays to the next one who may
                await self.admin[self.name].write(0)
        assert_tidy(self.rights.clients, "robot1:" + self.name)

    def _names_it(self):
        text = str(self.told)
        if self.lacking[0] not in "~&":
            return f"'{self.lacking}'" in text
        return bool(re.match(r"[A-Z.]+ \S*robot1:" if self.lacking != "~robot1:*" else rf".*{self.name}", text))

    async def _is(self, due, about):
        with contextlib.suppress(MissingKey):
            assert_same(await self.admin[self.name].read(), due, about)
            return
        assert due is None, about


async def tried(rights, space, kinds, *, late):
    """Try each kind of call without each of the rights that it uses; return how it ended, counted."""
    counts = collections.Counter()
    async with reem_async.RedisInterface(rights.host, namespace="robot1:") as interface:
        admin = reem_async.KeyValueStore(interface)
        for kind in kinds:
            trial = Trial(rights, admin, "foo", space, kind)
            rights.used()
            await trial.run(None, late=late)
            needed = rights.used()
            await trial.check()
            for lacking in sorted(needed):
                await admin["foo"].write(0)
                await trial.run(lacking, late=late)
                await trial.check()
                counts[type(trial.told).__name__ if trial.told else "done"] += 1
    return counts


def kinds_for(space):
    return [kind for kind in CALLS if space == "KeyValueStore" or kind != "an edit"]


@pytest.mark.parametrize("late", [False, True], ids=["from the beginning", "taken away later"])
@pytest.mark.parametrize("space", ["KeyValueStore", "PublishSpace"])
async def test_a_call_without_a_right_is_not_applied_or_says_what_was(single, space, late):
    counts = await tried(single, space, kinds_for(space)[:: sized(3, 1)], late=late)
    print(space, late, counts)
    assert counts["NotAllowed"] > sized(15, 50)


@pytest.mark.parametrize("space", ["KeyValueStore", "PublishSpace"])
async def test_a_call_without_a_right_in_a_cluster_is_not_applied_or_says_what_was(several, space):
    counts = await tried(several, space, random.Random(1).sample(kinds_for(space), sized(3, 6)), late=False)
    print(space, counts)
    assert counts["NotAllowed"] > sized(10, 30)
