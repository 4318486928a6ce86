"""Paths: where a value lives, as a tuple of keys and indexes.

A path is text at three borders only: what a user types (`parse`), what a user reads in messages (`show`), and what is
sent to the server (`to_jsonpath`, `suffix`). Elsewhere tuples are compared, so `foo` has nothing to do with `foobar`.
"""

from __future__ import annotations

import enum
import re
from collections.abc import Iterable, Sequence
from fnmatch import fnmatchcase
from functools import lru_cache
from typing import NamedTuple

import orjson

from ..errors import BadKey, BadType, BadValue
from .keys import keys_of

Path = tuple[str | int, ...]

LONGEST_TOP_KEY = 512  # bytes of UTF-8 in a top-level key and its namespace
_LOWEST_INDEX, _HIGHEST_INDEX = -(2**63), 2**63 - 1  # beyond, RedisJSON panics and the server exits
_LONGEST_INDEX = 40  # characters; Python refuses to read numbers of thousands of digits
_PLAIN = re.compile(r"[^\s.\[\]\"'\\~%\x00-\x1f]+")
# Three kinds of steps: `.key`, `[0]`, and `["any text"]`, quoted as in JSON. The dot before a key may be missing.
_TOKEN = re.compile(r"""\.?(?P<plain>[^.\[\]"~]+)|\[(?P<index>-?\d+)\]|\[(?P<quoted>"(?:[^"\\]|\\.)*")\]""", re.DOTALL)

_LIKE_A_PATH = re.compile(r"""[.\[\]"]""")

_TYPED = re.compile(_TOKEN.pattern.replace("~", ""), re.DOTALL)  # `~` is only special in names on the server


def check_element(key: object, parent: Path) -> str | int:
    """Return `key` if it can be an element of a path, else raise.

    Raises:
        BadType: Neither a str nor an int.
        BadKey: A str that the server's paths cannot address, or an int of more than 64 bits.
    """
    if isinstance(key, enum.Enum):
        raise BadKey(f"{show(parent)}: {shorten(key)} is an enum; use its .value")
    if isinstance(key, str):
        # RedisJSON skips spaces after an opening quote: " x" would name "x".
        if key.startswith(" ") or "\\" in key or ('"' in key and "'" in key) or not _encodable(key):
            raise BadKey(
                f"{show(parent)}: the key {shorten(key)} cannot be addressed by a path (it begins with a space, or has "
                "a backslash, both kinds of quotes, or half a surrogate pair); read or write the dict that holds it"
            )
        return key if type(key) is str else str.__str__(key)
    if isinstance(key, slice | tuple):
        raise BadType(
            f"{show(parent)}: an index names one item, not several ({shorten(key)}); read the whole first, and index "
            "that"
        )
    if isinstance(key, bool) or not hasattr(key, "__index__"):
        raise BadType(
            f"{show(parent)}: {shorten(key)} ({type(key).__name__}) is neither a key (str) nor a list index (int)"
        )
    index = int(key.__index__())
    if not _LOWEST_INDEX <= index <= _HIGHEST_INDEX:
        raise BadKey(f"{show(parent)}: no list has an item {shorten(index)}; indexes have 64 bits")
    return index


def check_name(key: object, parent: Path) -> str:
    if not isinstance(key, str):
        raise BadKey(f"{show(parent)}: the keys of a dict are str, not {shorten(key)} ({type(key).__name__})")
    return str(check_element(key, parent))


def check_namespace(namespace: object) -> str:
    """Return `namespace` if it can go before top-level keys; raises BadType or BadValue."""
    if not isinstance(namespace, str) or "{" in namespace or "}" in namespace:
        raise BadType(f"the namespace {shorten(namespace)} is not a str without braces")
    if not is_namespace(namespace):
        raise BadValue(
            f"the namespace {shorten(namespace)} does not end with a separator, so its keys would be mixed with those "
            f"of namespaces that begin with it (the key '0pose' of 'robot1' is the key 'pose' of 'robot10'); "
            f"write {shorten(namespace + ':')}"
        )
    if not _encodable(namespace) or len(namespace.encode()) >= LONGEST_TOP_KEY:
        raise BadValue(f"the namespace {shorten(namespace)} is not UTF-8, or leaves no room for keys; shorten it")
    return namespace


def is_namespace(text: str) -> bool:
    return not text[-1:].isalnum()


def check_top_key(key: object, room: int = LONGEST_TOP_KEY) -> str:
    """Return `key` if it can be a top-level key and has at most `room` bytes, else raise BadKey."""
    if not isinstance(key, str) or isinstance(key, enum.Enum):
        raise BadKey(f"the top-level key {shorten(key)} is not a str; use str(key)")
    key = str.__str__(key)
    if not key:
        raise BadKey("the top-level key is empty; give it a name")
    if "{" in key or "}" in key:
        raise BadKey(f"the top-level key {shorten(key)} has a brace; Redis Cluster uses them to place keys")
    if not _encodable(key) or len(key.encode()) > room:
        beside = "" if room == LONGEST_TOP_KEY else f" ({LONGEST_TOP_KEY} with its namespace)"
        raise BadKey(f"the top-level key {shorten(key)} is over {room} bytes{beside} or not UTF-8; shorten it")
    return key


def _encodable(text: str) -> bool:
    try:
        text.isascii() or text.encode()
    except UnicodeEncodeError:
        return False
    return True


def shorten(value: object, limit: int = 60) -> str:
    try:
        text = repr(value)
    except Exception:  # a broken __repr__ must not hide the real error
        text = f"<{type(value).__name__}>"
    if "\n" in text:  # of a table, for example
        text = " ".join(text.split())
    return text if len(text) <= limit else text[: limit - 3] + "..."


@lru_cache(maxsize=4096)
def to_jsonpath(path: Path) -> str:
    """Return the JSONPath below the document's root, every element quoted: `$["a"][0]`; raises BadKey.

    The server knows no escapes between the quotes. Elements are checked here too, since paths also come from notices,
    which any program may have published.
    """
    return "$" + "".join(_bracket(check_element(key, path[:place])) for place, key in enumerate(path))


def _bracket(key: str | int) -> str:
    if isinstance(key, int):
        # The server reads an index that is too negative as the first item, but not such a slice.
        return f"[{key}]" if key >= -1 else f"[{key}:{key + 1}]"
    return f"['{key}']" if '"' in key else f'["{key}"]'


@lru_cache(maxsize=4096)
def suffix(path: Path) -> str:
    """Return the text form of a path below a top-level key: `.bar.image`, `.tiles[0]`, `["a.b"]`."""
    return "".join(_step(key) for key in path)


def _step(key: str | int) -> str:
    if isinstance(key, int):
        return f"[{key}]"
    return f".{key}" if _PLAIN.fullmatch(key) else f"[{orjson.dumps(key).decode()}]"


def parse_suffix(text: str) -> Path:
    """Return the path that `suffix` turned into `text`, without the unique tail behind `~`; raises BadKey."""
    return _parse_short(text) if len(text) <= _SHORT else _split(text, _TOKEN)


def _split(text: str, tokens: re.Pattern[str], added: int = 0) -> Path:
    position, path = 0, []
    while position < len(text) and not (tokens is _TOKEN and text[position] == "~"):
        token = tokens.match(text, position)
        if token is None:
            where = max(position - added, 0)
            raise BadKey(f"{shorten(text[added:])} is not a path, at character {where}; write it like foo.bar[0]")
        path.append(_element(token))
        position = token.end()
    return tuple(path)


# Long texts are not cached: a foreign program may have put any number of them on the server.
_parse_short = lru_cache(maxsize=4096)(lambda text: _split(text, _TOKEN))
_SHORT = 512


def _element(token: re.Match[str]) -> str | int:
    if token["index"] is not None:
        if len(token["index"]) > _LONGEST_INDEX:
            raise BadKey(f"no list has an item {shorten(token['index'])}; indexes have 64 bits")
        return int(token["index"])
    if token["quoted"] is None:
        return token["plain"]
    try:
        key: str = orjson.loads(token["quoted"])
    except orjson.JSONDecodeError:
        raise BadKey(f"{shorten(token['quoted'])} is not a quoted key") from None
    return key


def parse(text: str) -> Path:
    """Return the path a user typed: `foo.bar`, `foo.tiles[2]`, `.a.b`; "." and "" are the root. Raises BadKey."""
    if not isinstance(text, str):
        raise BadType(f"a path is a str like 'foo.bar', not {shorten(text)}")
    path = parse_shown(text)
    # A top-level key may be any text. A path that begins with a dot has none.
    unchecked = 0 if text.startswith(".") else 1
    return (*path[:unchecked], *(check_element(key, path[:unchecked]) for key in path[unchecked:]))


def parse_shown(text: str) -> Path:
    """Return the path that `show` turned into `text`, even if the server cannot address it; raises BadKey."""
    if text in ("", "."):
        return ()
    return _split(text, _TYPED) if text[0] in ".[" else _split("." + text, _TYPED, 1)


def show(path: Path) -> str:
    """Return a full path as text: `foo.bar[0]`, or `["m.a"].x` if a key looks like a path."""
    if not path:
        return "(root)"
    top = str(path[0])
    return (_step(top) if _LIKE_A_PATH.search(top) else top) + suffix(path[1:])


@lru_cache(maxsize=4096)
def counts_from_end(path: Path) -> bool:
    return any(isinstance(key, int) and key < 0 for key in path)


@lru_cache(maxsize=4096)
def has_index(path: Path) -> bool:
    """Return whether the path leads through a list, whose items move when others are deleted."""
    return any(isinstance(key, int) for key in path)


def below(path: Path, ancestor: Path) -> bool:
    """Return whether `path` is `ancestor` itself or anything inside it."""
    return path[: len(ancestor)] == ancestor


def related(one: Path, other: Path) -> bool:
    """Return whether one path leads to, or through, the other: a change at one changes what is at the other."""
    return below(one, other) or below(other, one)


def may_hold(written: Path, member: Path) -> bool:
    """Return whether a write at `written` may have replaced the attachment `member`.

    All indexes count as equal: a deletion moves items of a list, while the names of their attachments stay.
    """
    return len(written) <= len(member) and all(
        ours == theirs or (isinstance(ours, int) and isinstance(theirs, int))
        for ours, theirs in zip(written, member, strict=False)
    )


# Patterns: globs of top-level keys and of paths below them.


# The server's globs know sets, [abc], and escapes. Those of users have neither: brackets are list indexes there.
_SPECIAL = re.compile(r"([*?\[\]\\^])")
_BRACKETS = re.compile(r"([\[\]\\^])")
_PATTERN_TOKEN = re.compile(rb"\\.|.", re.DOTALL)
_TAIL = "}:notices"
_LONGEST_TAIL = len("{}:notices@") + 10  # bytes of a channel without the key


class Pattern(NamedTuple):
    top: str  # the glob of the top-level key, with `*` and `?`
    rest: Path = ()  # globs of the elements below it; empty for all

    @property
    def glob(self) -> str:
        return _BRACKETS.sub(r"\\\1", self.top)

    def concerns(self, path: Path) -> bool:
        return all(_alike(ours, theirs) for ours, theirs in zip((self.top, *self.rest), path, strict=False))


def _alike(ours: str | int, theirs: str | int) -> bool:
    # Most patterns are plain names or "*", which need no regular expression.
    return ours == theirs or ours == "*" or (isinstance(ours, str) and fnmatchcase(str(theirs), _literal(ours)))


@lru_cache(maxsize=1024)
def _literal(glob: str) -> str:
    return _BRACKETS.sub(r"[\1]", glob)


def parse_pattern(text: str) -> Pattern:
    """Return the pattern that a user typed, without `**` at its end; raises BadKey."""
    top, *rest = parse(text) or ("*",)
    while rest and rest[-1] == "**":
        rest.pop()
    return Pattern(check_top_key(top), tuple(rest))


def parse_patterns(texts: Sequence[str]) -> list[Pattern]:
    if isinstance(texts, str | bytes) or not isinstance(texts, Iterable):
        raise BadType(f"patterns={shorten(texts)} is not a list of patterns; use [{shorten(texts)}]")
    return [parse_pattern(text) for text in texts]


def spelled_out(rest: Path) -> Path:
    """Return the beginning of a pattern's `rest` up to the first element with `*` or `?`."""
    for place, key in enumerate(rest):
        if isinstance(key, str) and ("*" in key or "?" in key):
            return rest[:place]
    return rest


def escaped(text: str) -> str:
    return _SPECIAL.sub(r"\\\1", text)


def channel_pattern(pattern: Pattern, namespace: str, database: int) -> bytes:
    """Return the glob pattern of the channels of all top-level keys that a pattern names."""
    # NUL in the key's place: nothing else in the name of a channel is NUL.
    channel = keys_of("\0", namespace="", database=database).channel
    return channel.replace("\0", escaped(namespace) + pattern.glob).encode()


def fits(glob: bytes, channel: bytes) -> bool:
    """Return whether `channel` fits a pattern of the server, in which `?` is one byte."""
    return _compiled(glob).fullmatch(channel) is not None


@lru_cache(maxsize=1024)
def _compiled(glob: bytes) -> re.Pattern[bytes]:
    parts = [
        b".*" if token == b"*" else b"." if token == b"?" else re.escape(token[-1:])
        for token in _PATTERN_TOKEN.findall(glob)
    ]
    return re.compile(b"".join(parts), re.DOTALL)


def name_of(channel: bytes, namespace: str) -> str:
    return channel.decode(errors="replace").rpartition(_TAIL)[0][1 + len(namespace) :]


def names_key(channel: bytes) -> bool:
    """Return whether `channel` is that of a valid key: a pattern also matches channels of foreign programs."""
    return len(channel) <= LONGEST_TOP_KEY + _LONGEST_TAIL and _names_key(channel)


@lru_cache(maxsize=4096)
def _names_key(channel: bytes) -> bool:
    try:
        name, _, _ = channel.decode().rpartition(_TAIL)
        check_top_key(name[1:])
    except (UnicodeDecodeError, BadKey):
        return False
    return name.startswith("{")
