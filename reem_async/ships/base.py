"""The base classes of ships, which carry one type of value to the server and back, and the ship for bytes."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Awaitable
from typing import Any

from ..errors import BadData


class SpecialDatatypeShip(ABC):
    """Base of the classes that store a custom type on the server.

    The five methods of this class may be plain functions or `async def`. A ship never talks to the server itself:
    the `client` it is given records commands (with redis-py's names: `set`, `hset`, `rpush`, ...)
    and REEM sends them inside the transaction of the whole write or read. Values of exactly the
    types str, int, float, bool, None, dict, list and tuple are JSON; they are offered to ships only if one claims such
    a type: its `check_fit` takes one of a few short samples, or its `claims` names the type. Then every value is
    visited in Python, which takes time.
    """

    carries: type | None = None
    """The type of all values of this ship, if there is only one. Optional."""

    claims: tuple[type, ...] = ()
    """JSON types of which `check_fit` takes long values only. Optional."""

    @abstractmethod
    def check_fit(self, value: Any) -> bool | Awaitable[bool]:
        """Return whether this ship takes `value`. The first ship of the list that does is used."""

    @abstractmethod
    def write(self, key: str, value: Any, client: Any) -> Awaitable[None] | None:
        """Record on `client` the commands that store `value` under `key`.

        Everything must go under this one key (a hash holds several parts). The key is empty when
        the commands run: REEM has removed what was there.
        """

    @abstractmethod
    def read(self, key: str, client: Any) -> Awaitable[None] | None:
        """Record on `client` the ONE command that fetches all of what `write` stored under `key`.

        Called once per interface with a stand-in key, which is replaced by the real ones later.
        """

    @abstractmethod
    def interpret_read(self, responses: list[Any]) -> Any:
        """Return the value. `responses` holds one item, the reply to the command of `read`."""

    @abstractmethod
    def get_label(self) -> str | Awaitable[str]:
        """Return the name of this kind of ship; it tells readers which ship to use."""

    def describe(self, value: Any) -> tuple[int, str]:
        """Return the bytes `value` takes and a few words on it, shown in the document.

        Optional. Raise `BadType` or `BadValue` for a value that cannot be carried: nothing has been
        sent at this point.
        """
        return 0, type(value).__name__


class BlobShip(SpecialDatatypeShip):
    """A ship whose value is one string of bytes under its key.

    Its values are sent and received without being copied, and small ones also travel inside the
    notice of an update.
    """

    tolerated = False
    """Whether bytes that `unpack` refuses may be those that were published: the rest of the update is delivered."""

    @abstractmethod
    def pack(self, value: Any) -> tuple[Any, ...]:
        """Return the bytes as a few pieces, each bytes or a flat buffer of bytes."""

    @abstractmethod
    def unpack(self, blob: Any) -> Any:
        """Return the value from its bytes (any buffer; None if they are gone); raise `BadData` for others."""

    def write(self, key: str, value: Any, client: Any) -> None:
        client.set(key, b"".join(self.pack(value)))

    def read(self, key: str, client: Any) -> None:
        client.get(key)

    def interpret_read(self, responses: list[Any]) -> Any:
        return self.unpack(responses[0])


class BytesShip(BlobShip):
    """Carries bytes; a bytearray comes back as bytes."""

    carries = bytes

    def get_label(self) -> str:
        return "bytes"

    def check_fit(self, value: Any) -> bool:
        return isinstance(value, bytes | bytearray)

    def describe(self, value: bytes) -> tuple[int, str]:
        return len(value), "bytes"

    def pack(self, value: bytes) -> tuple[bytes, ...]:
        return (bytes(value),)

    def unpack(self, blob: Any) -> bytes:
        if blob is None:
            raise BadData("the bytes are gone from the server (evicted, or removed by a program without REEM)")
        return bytes(blob)
