"""Patterns: which top-level keys, and which paths below them, somebody wants to hear of or list."""

from __future__ import annotations

import re
from collections.abc import Iterable, Sequence
from fnmatch import fnmatchcase
from functools import lru_cache
from typing import NamedTuple

from ..errors import BadKey, BadType
from .keys import keys_of
from .paths import LONGEST_TOP_KEY, Path, check_top_key, parse, shorten

__all__ = [
    "Pattern", "channel_pattern", "escaped", "fits", "name_of", "names_key", "parse_pattern", "parse_patterns",
    "spelled_out",
]  # fmt: skip

# The server's globs know sets, [abc], and escapes. What users type has neither: brackets are list indexes there.
_SPECIAL = re.compile(r"([*?\[\]\\^])")
_BRACKETS = re.compile(r"([\[\]\\^])")
_TOKEN = re.compile(rb"\\.|.", re.DOTALL)
_TAIL = "}:notices"
_LONGEST_TAIL = len("{}:notices@") + 10
"""Bytes of a channel beside the key."""


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
    # Most patterns are names spelled out, or "*": both are told without a regular expression.
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


def parse_patterns(texts: Sequence[str]) -> list[Pattern]:
    """Return several patterns; raises BadKey, and BadType for what is no list of them."""
    if isinstance(texts, str | bytes) or not isinstance(texts, Iterable):
        raise BadType(f"patterns={shorten(texts)} is not a list of patterns; use [{shorten(texts)}]")
    return [parse_pattern(text) for text in texts]


def spelled_out(rest: Path) -> Path:
    """Return the beginning of what is below the top of a pattern in which nothing stands for something else."""
    for place, key in enumerate(rest):
        if isinstance(key, str) and ("*" in key or "?" in key):
            return rest[:place]
    return rest


def escaped(text: str) -> str:
    """Return the server's glob pattern for exactly `text`."""
    return _SPECIAL.sub(r"\\\1", text)


def channel_pattern(pattern: Pattern, namespace: str, database: int) -> bytes:
    """Return the glob pattern of the channels of all top-level keys that a pattern names."""
    # A stand-in for the key: nothing else in the name of a channel is NUL.
    channel = keys_of("\0", namespace="", database=database).channel
    return channel.replace("\0", escaped(namespace) + pattern.glob).encode()


def fits(glob: bytes, channel: bytes) -> bool:
    """Return whether the server finds that `channel` fits its pattern `glob`, of which each `?` is one byte."""
    return _compiled(glob).fullmatch(channel) is not None


@lru_cache(maxsize=1024)
def _compiled(glob: bytes) -> re.Pattern[bytes]:
    parts = [
        b".*" if token == b"*" else b"." if token == b"?" else re.escape(token[-1:]) for token in _TOKEN.findall(glob)
    ]
    return re.compile(b"".join(parts), re.DOTALL)


def name_of(channel: bytes, namespace: str) -> str:
    """Return the top-level key whose notices come on `channel`."""
    return channel.decode(errors="replace").rpartition(_TAIL)[0][1 + len(namespace) :]


def names_key(channel: bytes) -> bool:
    """Return whether `channel` is that of a key which can be: a pattern brings whatever strangers publish on."""
    return len(channel) <= LONGEST_TOP_KEY + _LONGEST_TAIL and _names_key(channel)


@lru_cache(maxsize=4096)
def _names_key(channel: bytes) -> bool:
    try:
        name, _, _ = channel.decode().rpartition(_TAIL)
        check_top_key(name[1:])
    except (UnicodeDecodeError, BadKey):
        return False
    return name.startswith("{")
