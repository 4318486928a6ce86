"""The browser, run for tests: a real uvicorn on a real port, in a thread of its own."""

import asyncio
import contextlib
import threading

import httpx
import pytest
from conftest import PATIENCE, eventually

from reem_async import RedisInterface
from reem_async.tools.browser import LiveSource, PageServer, create_app, listen


@contextlib.contextmanager
def served(make_source, **options):
    """Serve what `make_source` makes; yields the address and the source."""
    sock = listen("127.0.0.1", 0)
    address = f"http://127.0.0.1:{sock.getsockname()[1]}"
    made, failed = [], []

    async def run():
        source = make_source()
        server = PageServer(create_app(source, **options), sock)
        made.extend([source, server])
        await server.run_until_stopped()

    def work():
        try:
            asyncio.run(run())
        except BaseException as error:
            failed.append(error)
            raise

    thread = threading.Thread(target=work, name="browser")
    thread.start()
    try:
        eventually(lambda: failed or (len(made) == 2 and made[1].started))
        yield address, made[0]
    finally:
        eventually(lambda: failed or len(made) == 2)
        if len(made) == 2:
            made[1].stop()
        thread.join(PATIENCE)
        sock.close()
        assert not thread.is_alive(), "the browser did not end"


def live(url, seconds=60.0, budget=64 << 20, namespace=""):
    return lambda: LiveSource(RedisInterface(url, namespace=namespace), seconds, budget)


class Client:
    def __init__(self, address, **options):
        self.http = httpx.Client(base_url=address, timeout=PATIENCE, trust_env=False, **options)

    def ask(self, what, **values):
        return self.http.get(f"/api/{what}", params=values)

    def json(self, what, **values):
        answer = self.ask(what, **values)
        assert answer.status_code == 200, answer.text
        return answer.json()

    def rows(self, path="", **values):
        (branch,) = self.json("tree", open=f"1000:0:{path}", **values)["branches"]
        assert "error" not in branch, branch
        return {node["label"]: node for node in branch["nodes"]}


@contextlib.contextmanager
def client_of(address, **options):
    client = Client(address, **options)
    with contextlib.closing(client.http):
        yield client


@pytest.fixture(scope="module")
def address(server_url):
    with served(live(server_url)) as (address, _):
        yield address


@pytest.fixture
def ask(address):
    with client_of(address) as client:
        yield client
