"""Bytes: stored as they are."""

from __future__ import annotations

from typing import Any

from ..errors import BadData
from .base import BlobShip


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
