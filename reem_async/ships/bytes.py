"""Bytes: stored as they are."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from ..errors import BadData
from .base import FieldShip

__all__ = ["BytesShip"]


class BytesShip(FieldShip):
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

    def pack(self, value: bytes) -> dict[str, Any]:
        """Return the one field raw."""
        return {"raw": bytes(value)}

    def unpack(self, fields: Mapping[bytes, bytes]) -> bytes:
        """Return the bytes."""
        try:
            return fields[b"raw"]
        except (KeyError, TypeError):
            raise BadData("stored bytes lack the field raw") from None
