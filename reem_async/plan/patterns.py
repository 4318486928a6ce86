"""Patterns: which top-level keys, and which paths below them, somebody wants to hear of or list."""

from __future__ import annotations

import re
from fnmatch import fnmatchcase
from functools import lru_cache
from typing import NamedTuple

from .keys import keys_of
from .paths import Path, check_top_key, parse

__all__ = ["Pattern", "channel_pattern", "escaped", "name_of", "parse_pattern"]

_SPECIAL = re.compile(r"([*?\[\]\\^])")
_BRACKETS = re.compile(r"([\[\]\\^])")


class Pattern(NamedTuple):
    """A glob over paths, such as `arm`, `cam_*` or `robot.*.battery`.

    Attributes:
        top: The glob for the top-level key: `*` and `?` stand for other characters.
        rest: Globs for what is below it; empty for all.
    """

    top: str
    rest: Path = ()

    @property
    def glob(self) -> str:
        """The server's form of `top`."""
        return _BRACKETS.sub(r"\\\1", self.top)

    def concerns(self, path: Path) -> bool:
        """Return whether a change at the full `path` changes something that the pattern names."""
        return all(_alike(ours, theirs) for ours, theirs in zip((self.top, *self.rest), path, strict=False))


def _alike(ours: str | int, theirs: str | int) -> bool:
    return ours == theirs or ours == "*" or (isinstance(ours, str) and fnmatchcase(str(theirs), _literal(ours)))


@lru_cache(maxsize=1024)
def _literal(glob: str) -> str:
    """Return a glob in which only `*` and `?` stand for other characters."""
    return _BRACKETS.sub(r"[\1]", glob)


def parse_pattern(text: str) -> Pattern:
    """Return the pattern a user typed; `**` at the end may be left out.

    Raises:
        BadKey: Not a pattern of dotted keys.
    """
    top, *rest = parse(text) or ("*",)
    while rest and rest[-1] == "**":
        rest.pop()
    return Pattern(check_top_key(top), tuple(rest))


def escaped(text: str) -> str:
    """Return the server's glob pattern for exactly `text`."""
    return _SPECIAL.sub(r"\\\1", text)


def channel_pattern(pattern: Pattern, namespace: str, database: int) -> bytes:
    """Return the glob pattern of the channels of all top-level keys that a pattern names."""
    channel = keys_of("\0", namespace="", database=database).channel
    return channel.replace("\0", escaped(namespace) + pattern.glob).encode()


def name_of(channel: bytes, namespace: str) -> str:
    """Return the top-level key whose notices come on `channel`."""
    return channel.decode(errors="replace").rpartition("}:notices")[0][1 + len(namespace) :]
