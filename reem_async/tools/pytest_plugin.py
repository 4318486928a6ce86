"""The pytest fixture `reem_server`: a private, real, empty server for each test.

pytest finds it by itself where REEM is installed. Nothing of REEM is imported before a test asks for the fixture.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import TYPE_CHECKING

import pytest

if TYPE_CHECKING:
    from reem_async.server import EmbeddedServer

__all__ = ["reem_server"]

BATCH = 1000  # keys removed by one command


@pytest.fixture(scope="session")
def _reem_server_process() -> Iterator[EmbeddedServer]:
    """One server process for the whole test run; starting one takes about 0.1 s."""
    from reem_async.errors import ServerMissing
    from reem_async.server import EmbeddedServer

    try:
        server = EmbeddedServer()
        server.start()
    except ServerMissing as missing:
        pytest.fail(f"the fixture reem_server needs a server program: {missing}", pytrace=False)
    yield server
    server.stop()


@pytest.fixture
def reem_server(_reem_server_process: EmbeddedServer) -> EmbeddedServer:
    """Return an empty server that only this test run uses: `RedisInterface(reem_server)` connects to it.

    All tests of a run share one process, and each test begins without any keys. With pytest-xdist each worker has
    a server of its own.
    """
    from reem_async.connection import RedisInterface
    from reem_async.transport.client import client

    with client(RedisInterface(_reem_server_process).session.options) as plain:
        names = list(plain.scan_iter(count=BATCH))
        for start in range(0, len(names), BATCH):
            plain.unlink(*names[start : start + BATCH])
    return _reem_server_process
