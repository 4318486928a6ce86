"""Bytes: stored as they are."""

from __future__ import annotations

from typing import Any

from ..errors import BadData
from .base import BlobShip


class BytesShip(BlobShip):
    """Carries bytes; a bytearray comes back as bytes."""

    carries = bytes

    def get_label(self) -> str:
        """Return "bytes"."""
        return "bytes"

    def check_fit(self, value: Any) -> bool:
        """Return whether `value` is bytes or a bytearray."""
        return isinstance(value, bytes | bytearray)

    def describe(self, value: bytes) -> tuple[int, str]:
        """Return the length and the word bytes."""
        return len(value), "bytes"

    def pack(self, value: bytes) -> tuple[bytes, ...]:
        """Return the bytes in one piece."""
        return (bytes(value),)

    def unpack(self, blob: Any) -> bytes:
        """Return the bytes."""
        if blob is None:
            raise BadData("the bytes are gone from the server (evicted, or removed by a program without REEM)")
        return bytes(blob)
