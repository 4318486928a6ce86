"""The last command of a program: whatever runs while the interpreter exits may still write and publish."""

import pytest
from conftest import LONG, python

PROGRAM = """
import atexit, logging, os, sys, threading, time, weakref

def last(say=os.write):
    say(1, b"called")
    for space, key in spaces:
        space[key] = {{"motor": "off"}}
        space[key]["motor"] = "off, again"

class AtEnd:
    def __init__(self, cycle=False):
        self.me = self if cycle else None
    def __del__(self):
        last()

class Handler(logging.NullHandler):  # asyncio logs what a busy machine makes slow
    def close(self):
        last()
        super().close()

def generator():
    try:
        yield
    finally:
        last()

{before}
import reem
url, *keys = sys.argv[1:]
class Ship(reem.ships.BytesShip):
    async def write(self, key, value, client):
        return super().write(key, value, client)
spaces = []
for kind, ship in ((reem.KeyValueStore, {ship}), (reem.PublishSpace, {ship})):
    interface = reem.RedisInterface(url, ships=ship and [ship()])
    spaces.append((kind(interface), keys[len(spaces)]))
for key in keys[2:]:  # connects as late as that
    spaces.append((reem.KeyValueStore(reem.RedisInterface(url)), key))
for space, key in spaces[:2]:
    space[key] = "on"
    calls = reem.CallbackSubscriber(key, space.interface, lambda data, updated_path: None)
    calls.listen()
    watch = reem.KeyValueStore(space.interface)[key].watch()
    next(watch)  # from here on it only waits, and uses no connection of this thread
    threading.Thread(target=list, args=[watch], daemon=True).start()
{after}
"""

ENDS = {  # what runs before the import of REEM, and at the end of the program
    "atexit, before the import": ("atexit.register(last)", ""),
    "atexit, after the interface": ("", "atexit.register(last)"),
    "a finalizer, before the import": ("def gone(): pass\nweakref.finalize(gone, last)", ""),
    "a log handler": ("logging.getLogger().addHandler(Handler())", ""),
    "__del__ of a global": ("at_end = AtEnd()", ""),
    "__del__ of a cycle": ("at_end = AtEnd(cycle=True)", ""),
    "__del__ of a global made last": ("", "at_end = AtEnd()"),
    "__del__ of a cycle made last": ("", "at_end = AtEnd(cycle=True)"),
    "a generator": ("", "at_end = generator(); next(at_end)"),
    "a thread that outlives the main one": (
        "", "threading.Thread(target=lambda: (threading.main_thread().join(), last())).start()",
    ),
    "sys.exit": ("atexit.register(last)", "sys.exit(0)"),
    "an interface that was closed for others": ("atexit.register(last)", "reem.RedisInterface(url).close()"),
}  # fmt: skip
AFTER_MODULES = [end for end in ENDS if end.startswith("__del__") or end == "a generator"]

CASES = [(end, ship) for end in ENDS for ship in ("None", "Ship") if ship == "None" or end not in AFTER_MODULES]
"""A ship that needs an event loop needs a new connection, which cannot be had behind the modules."""


@pytest.mark.parametrize(("end", "ship"), [case for number, case in enumerate(CASES) if LONG or number % 3 != 1])
def test_the_last_command_arrives_whatever_sends_it(server_url, key, kvs, end, ship):
    """Stored or published, beside followers, also with a ship that needs an event loop; the exit is quiet."""
    before, after = ENDS[end]
    keys = [key() for _ in range(3)]
    if end in AFTER_MODULES:  # redis-py imports for each new connection, which fails by then
        keys.pop()
    done = python(PROGRAM.format(before=before, after=after, ship=ship), server_url, *keys)
    assert (done.returncode, done.stderr) == (0, "")
    assert done.stdout == "called"
    assert [kvs[each].read() for each in keys] == [{"motor": "off, again"}] * len(keys)
