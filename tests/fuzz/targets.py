"""The targets: each takes any bytes and raises something only if a decoder does what it must not."""

import random

import numpy as np
import orjson

from reem_async.errors import BadData, BadKey
from reem_async.plan import notices, paths, placeholders
from reem_async.plan.keys import keys_of
from reem_async.plan.replies import loads, refusal
from reem_async.ships.base import BytesShip
from reem_async.ships.numpy import NumpyShip
from reem_async.ships.registry import Ships
from reem_async.transport.protocol import MORE, NOT_THE_PROTOCOL, CommandRecorder, LargeReader, SmallReader

SHIPS = Ships([NumpyShip(), BytesShip()], CommandRecorder)
KEYS = keys_of("foo")


def npy(data):
    """A stored array: the right one, or BadData; it never takes more memory than was sent."""
    try:
        array = NumpyShip().unpack(data)
    except BadData:
        return
    assert array.nbytes <= len(data), (array.nbytes, len(data))
    assert not array.dtype.hasobject
    assert not array.flags.writeable


def notice(data):
    """A published message: a sound notice, or BadData."""
    try:
        decoded = notices.decode(data, SHIPS)
    except BadData:
        return
    assert type(decoded.publisher) is str
    assert type(decoded.sequence) is int
    assert all(type(key) in (str, int) for key in decoded.path)
    paths.show(("foo", *decoded.path))


def document(data):
    """The text of a stored document: what it holds, or BadData."""
    try:
        holder = loads(data, KEYS)
        slots = placeholders.find(holder, "foo")
    except BadData:
        return
    suffixes = {slot.placeholder.suffix for slot in slots}
    assert len(suffixes) == len(slots), "one array, many copies"


def placeholder(data):
    """A string that begins with the mark: what it stands for, or BadData; written again it is the same."""
    text = placeholders.MARK + data.decode(errors="replace")
    try:
        meaning = placeholders.parse(text)
    except BadData:
        return
    if isinstance(meaning, placeholders.Placeholder) and meaning.label not in ("", *placeholders.INLINE_LABELS):
        assert placeholders.parse(str(meaning)) == meaning


def replies(data):
    """What a server sends, in pieces: replies, or one of the errors that end a connection."""
    dice = random.Random(len(data))
    for reader in (SmallReader(), LargeReader()):
        try:
            start = 0
            while start < len(data):
                place = reader.target()
                size = min(len(place), len(data) - start, dice.choice((1, 7, 100, 1 << 20)))
                place[:size] = data[start : start + size]
                del place
                reader.received(size)
                start += size
                while reader.gets() is not MORE:
                    pass
        except NOT_THE_PROTOCOL:
            pass


def errors(data):
    """The text of an error reply: REEM's error, redis-py's, or none; always short."""
    told = refusal(data.decode(errors="replace"))
    assert told is None or len(str(told)) < 600


def path(data):
    """What a user, or a registry, says is a path: BadKey, or a path that is the same when written again."""
    text = data.decode(errors="replace")
    for parse in (paths.parse, paths.parse_suffix):
        try:
            parsed = parse(text)
        except BadKey:
            continue
        assert paths.parse_suffix(paths.suffix(parsed)) == parsed
        if parse is paths.parse:
            quoted = paths.to_jsonpath(parsed[1:])  # the first is a top-level key: the name of the document
            assert quoted.startswith("$")
            for key in parsed[1:]:  # each element stands in brackets and quotes of which nothing in it is one
                assert _step(key) in quoted


def _step(key):
    if isinstance(key, int):  # an index from the end, but the last, is sent as a slice of one item
        return f"[{key}:{key + 1}]" if key < -1 else f"[{key}]"
    return f'["{key}"]' if '"' not in key else f"['{key}']"


TARGETS = {each.__name__: each for each in (npy, notice, document, placeholder, replies, errors, path)}


# --- where to begin ------------------------------------------------------------------------------


def blob(array):
    return b"".join(bytes(piece) for piece in NumpyShip().pack(array))


def header(descr, shape, rest=b"", version=1, order=False):
    """An .npy file with a header of one's own; `descr` is its text."""
    text = f"{{'descr': {descr}, 'fortran_order': {order}, 'shape': {shape}, }}\n".encode()
    size = len(text).to_bytes(2 if version == 1 else 4, "little")
    return b"\x93NUMPY" + bytes([version, 0]) + size + text + rest


def _seeds():
    nested = np.dtype([("a", "<f8"), ("b", [("x", "<i2", (2, 3)), ("y", "S5")]), ("t", "<M8[ns]")])
    arrays = [
        np.arange(6.0).reshape(2, 3),
        np.zeros((0, 3), "<U4"),
        np.array(5, ">i4"),
        np.zeros(3, nested),
        np.array([b"ab", b"c"]),
        np.array(["2020-01-01"], "M8[D]"),
        np.ones(4, bool),
    ]
    stored = [blob(array) for array in arrays]
    small = stored[0]
    parts = [["numpy", ".image", len(small)]]
    text = b'{"n":1,"image":"$ship numpy .image 48 float64[2,3]"}'
    head = orjson.dumps([1, "abc123", 7, 1.5, ["a", 0, "b"], "set", len(text), parts]) + b"\n"
    look = orjson.dumps([1, "abc123", 8, 1.5, ["a"], "look", 10**6, []]) + b"\n"
    protocol = (
        b"*2\r\n$3\r\nfoo\r\n:1\r\n+OK\r\n_\r\n%1\r\n$1\r\na\r\n,1.5\r\n>3\r\n$7\r\nmessage\r\n$1\r\nc\r\n$2\r\nhi\r\n"
        b"-OOM full\r\n#t\r\n(123\r\n~1\r\n:2\r\n=5\r\ntxt:a\r\n$-1\r\n*-1\r\n"
    )
    return {
        "npy": stored,
        "notice": [head + text + small, look, orjson.dumps([1, "x", 1, 0, [], "delete", 0, []]) + b"\n"],
        "document": [
            b"[" + text + b"]",
            b'[{"a":"$ship numpy .a 1 x","b":["$ship numpy .b 1 x"]}]',
            b'[["$ship text $ship a","$ship float 0x1.8p+0"]]',
        ],
        "placeholder": [b"numpy .image 48 float64[2,3]", b"text hello", b"float 0x1.8p+0", b"my%20ship .a%25b~1 0"],
        "replies": [protocol, b"$40000\r\n" + b"x" * 40000 + b"\r\n"],
        "errors": [b"OOM command not allowed", b"MOVED 1 a:1", b"ERR unknown command 'JSON.GET', with"],
        "path": [b"foo.bar[0].baz", b'.a["b.c"][12]', b"~a.b"],
    }


SEEDS = _seeds()
WORDS = [
    b"'descr'", b"'shape'", b"'|O'", b"'<f8'", b"'|V999999999'", b"'<U999999999'", b"'O'", b"(", b")", b"[", b"]", b"{",
    b"}", b",", b"-1", b"0", b"999999999999999", b"281474976710655", b"True", b"False", b"None", b"lambda: 0",
    b"__import__('os')", b"-" * 50, b"((((" * 20, b"[[[[" * 20, b"\r\n", b"*", b"$", b"%", b">", b"$999999999999\r\n",
    b"*999999999999\r\n", b"$ship ", b'"', b"\\", b"\x00", b"\xff", b"1e400", b"1_000", b"~", b"..", b"[-1]", b"null",
]  # fmt: skip


def mutants(name, count, seed):
    """Yield `count` inputs for a target, spoilt copies of what is valid; the same for the same seed."""
    dice = random.Random(f"{name} {seed}")
    seeds = SEEDS[name]
    for _ in range(count):
        data = bytearray(dice.choice(seeds))
        for _ in range(dice.choice((1, 1, 2, 3, 8, 30))):
            place = dice.randrange(len(data) + 1)
            match dice.randrange(6):
                case 0 if data:
                    data[place % len(data)] ^= 1 << dice.randrange(8)
                case 1:
                    data[place:place] = dice.choice(WORDS)
                case 2:
                    del data[place : place + dice.choice((1, 2, 8, 64))]
                case 3:
                    data[place : place + 4] = dice.randbytes(dice.choice((1, 4, 16)))
                case 4:
                    other = dice.choice(seeds)
                    cut = dice.randrange(len(other) + 1)
                    data[place:] = other[cut:]
                case _:
                    data[place:place] = data[place : place + 40] * dice.choice((1, 2, 20))
        yield bytes(data[:200_000])
