"""A fork while another thread uses a feature for the first time: the child can use it too."""

import os
import time

import pytest
from conftest import python, sized

SEED = int(os.environ.get("REEM_TEST_SEED", time.time_ns() % 10**6))

USE = """
import faulthandler, os, random, signal, sys, tempfile, threading, time
import numpy as np
import reem
{imports}
url, key, seed = sys.argv[1:]
random.seed(int(seed))
folder = tempfile.mkdtemp()
array = np.zeros(30_000)

def use(name):
    kvs, space = reem.KeyValueStore(interface), reem.PublishSpace(interface)
    {use}
"""

PROGRAM = (
    USE
    + """
faulthandler.register(signal.SIGALRM, chain=True)

def forked(work, seconds):
    # Returns the number of a child, which is ended after so many seconds.
    pid = os.fork()
    if pid:
        return pid
    signal.alarm(seconds)
    try:
        work()
    except BaseException as error:
        sys.stderr.write(f"{{error!r}}\\n")
        os._exit(1)
    os._exit(0)

def first_use():
    # A program that has used nothing yet: one thread begins, and the other one forks meanwhile.
    global interface
    interface = reem.RedisInterface(url)
    thread = threading.Thread(target=use, args=["parent"])
    delay = random.uniform(0, {longest})
    thread.start()
    time.sleep(delay)
    child = forked(lambda: use("child"), 10)
    thread.join()
    status = os.waitpid(child, 0)[1]
    if status:
        sys.stderr.write(f"after {{delay * 1000:.2f}} ms the child ended with {{status}}\\n")
        os._exit(1)

bad = 0
for turn in range({turns}):
    bad += os.waitpid(forked(first_use, 25), 0)[1] != 0
print(bad)
"""
)

IMPORTED = """
interface = reem.RedisInterface(url)
before = set(sys.modules)
use("alone")
print(sorted(set(sys.modules) - before))
"""

USES = {
    "store": "kvs[key] = 1; assert kvs[key].read() == 1",
    "array": "kvs[key] = {'a': array}; assert kvs[key].read()['a'].size == 30_000",
    "publish": "space[key] = {'n': 1}",
    "publish an array": "space[key] = {'n': array}",
    "arithmetic": "kvs[key + name] = 1; kvs[key + name].increment(1); kvs[key + name].divide(2)",
    "edit": "kvs[key + name] = {}\n    with kvs[key + name] as value: value['n'] = array",
    "watch": "kvs[key] = 1; assert next(kvs[key].watch()).data == 1",
    "watch of a pattern": "kvs[key] = 1; assert next(kvs.watch(key)).data == 1",
    "mirror": "kvs[key] = 1\n    with kvs[key].mirror() as mirror: assert mirror.value() == 1",
    "callback": (
        "called = threading.Event(); kvs[key] = 1\n"
        "    calls = reem.CallbackSubscriber(key, interface, lambda *_: called.set()); calls.listen()\n"
        "    while not called.wait(0.01): space[key] = 1"
    ),
    "silent subscriber": (
        "kvs[key] = 1; silent = reem.SilentSubscriber(key, interface); silent.listen(); assert silent.value() == 1"
    ),
    "keys": "kvs[key] = 1; assert key in kvs.keys(key)",
    "publish without waiting": "queued = reem.PublishSpace(interface, wait=False); queued[key] = {}; queued.flush(5)",
    "service": (
        "with kvs[key + name].serve(lambda x: x):\n"
        "        assert kvs[key + name].call(x=array, timeout=5).size == 30_000"
    ),
    "parameter": "assert kvs[key].parameter('kp', 2.0).value == 2.0",
    "owner": "with kvs[key + name].own(ttl=5) as owned: owned.write(1)",
    "plain client": "assert interface.client.ping()",
    "recorder": (
        "place = key + name; kvs[place] = array\n"
        "    with recording.Recorder(interface, [place], f'{folder}/{name}{os.getpid()}.mcap'): space[place] = array"
    ),
}


@pytest.mark.parametrize("use", USES)
def test_a_child_forked_during_the_first_use_of_a_feature_can_use_it(server_url, key, use):
    """No lock of the parent is left taken in the child. The seed is printed."""
    if use == "plain client" and "cluster" in server_url:
        pytest.skip("the plain client is for one server")
    imports = "from reem import recording" if use == "recorder" else ""
    done = python(USE.format(use=USES[use], imports=imports) + IMPORTED, server_url, key(), SEED, flags=())
    # A module that one thread is importing stays locked in a child that another thread forks meanwhile.
    assert (done.stdout, done.stderr) == ("[]\n", "")
    code = PROGRAM.format(use=USES[use], imports=imports, longest=0.03, turns=sized(3, 10))
    done = python(code, server_url, key(), SEED, flags=())
    assert (done.stdout, done.stderr) == ("0\n", ""), f"REEM_TEST_SEED={SEED}"
