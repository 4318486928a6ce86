"""Which server process is at the other end: what tells a restarted server from a broken connection."""

from __future__ import annotations

import re
from typing import Any

from ..errors import ConnectionLost, NotConnected
from ..plan import Command

__all__ = ["WHO", "unanswered", "who"]

WHO: Command = ("INFO", "server")
"""Asked once per connection; whoever may not ask does not get to know of restarts."""

_RUN = re.compile(rb"run_id:([0-9a-f]{8,64})")


def who(replies: Any) -> str | None:
    """Return what the server's process calls itself, None if it did not say (or if an error is given)."""
    # An error, or a user who may not ask: restarts are then not told of, and all else goes on.
    text = replies[0] if isinstance(replies, list) and replies else None
    found = _RUN.search(text) if isinstance(text, bytes | bytearray) else None
    return None if found is None else found[1].decode()


def unanswered(address: str, error: ConnectionLost) -> NotConnected:
    """Return the error to raise where a new connection broke at its first question: no call had been sent."""
    reason = str(error).partition("; the call")[0]
    return NotConnected(f"the server at {address} took the connection, and then: {reason}; nothing was applied")
