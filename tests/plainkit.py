"""Generated JSON commands, done by the module of a server and by REEM's own text; and clients for plain servers."""

import random
import re
import string
import struct

import hiredis
import orjson
import redis

from reem_async.plain.documents import MARK, Refusal, TextDocument
from reem_async.plan.paths import to_jsonpath
from reem_async.tools.snapshots.plans import settable

NAMES = [*"abcd", "a.b", "x y", "it's", 'say "hi"', "ä", "键一", "\U0001f600", "", "$", "[0]", "]", "a\nb"]
"""Keys of dicts; few, so that paths meet them."""

TEXTS = ["", "x", "\0\x01\x1f\x7f", 'quotes "\\/', "äöü€", "\U0001f600 键", "a\nb\tc", "1.5", "null"]
EDGES = [0, 1, -1, 2**31, 2**53 + 1, 2**63 - 1, -(2**63), 2**63, 2**64 - 1]


class Generator:
    """Documents, paths and commands of one seed."""

    def __init__(self, seed):
        self.random = random.Random(seed)

    def number(self):
        kind = self.random.randrange(6)
        if kind == 0:
            return self.random.choice(EDGES)
        if kind == 1:
            return self.random.randint(-1000, 1000)
        if kind == 2:
            return self.random.randint(-(2**63), 2**64 - 1)
        if kind == 3:
            return round(self.random.uniform(-100, 100), 3)
        if kind == 4:
            return self.random.uniform(-1, 1)
        while True:
            (value,) = struct.unpack("d", self.random.randbytes(8))
            if value == value and abs(value) != float("inf"):
                return value

    def value(self, depth=3):
        kind = self.random.randrange(9 if depth else 5)
        if kind <= 1:
            return self.number()
        if kind == 2:
            return self.random.choice([None, True, False])
        if kind <= 4:
            return self.random.choice(
                [*TEXTS, "".join(self.random.choices(string.printable, k=self.random.randrange(40)))]
            )
        count = self.random.randrange(5)
        if kind <= 6:
            return [self.value(depth - 1) for _ in range(count)]
        return {self.random.choice(NAMES): self.value(depth - 1) for _ in range(count)}

    def path(self, tree):
        """A path that leads somewhere in `tree` most of the time, and sometimes astray."""
        path = []
        while self.random.random() < 0.75:
            if isinstance(tree, dict) and tree and self.random.random() < 0.85:
                step = self.random.choice(list(tree))
            elif isinstance(tree, list) and tree and self.random.random() < 0.85:
                step = self.random.randrange(-len(tree), len(tree))
            else:
                step = self.random.choice([self.random.choice(NAMES), self.random.randrange(-4, 6)])
            path.append(step)
            try:
                tree = tree[step]
            except (LookupError, TypeError):
                tree = None
        return tuple(path)

    def place(self, tree):
        while True:
            try:
                return to_jsonpath(self.path(tree))
            except ValueError:  # a key that no path addresses
                continue

    def command(self, tree):
        place = self.place(tree)
        kind = self.random.randrange(20)
        if kind < 5:
            flag = self.random.choice([(), (), (), ("NX",), ("XX",)])
            return ("JSON.SET", place, settable(orjson.dumps(self.value())), *flag)
        if kind < 7:
            return ("JSON.DEL", place)
        if kind < 9:
            values = [settable(orjson.dumps(self.value(1))) for _ in range(self.random.randrange(1, 4))]
            return ("JSON.ARRAPPEND", place, *values)
        if kind < 12:
            name = self.random.choice(["JSON.NUMINCRBY", "JSON.NUMMULTBY"])
            operand = b'"'
            while operand.startswith(b'"'):  # a float that the module's way of reading decimals cannot hit
                operand = settable(orjson.dumps(self.number()))
            return (name, place, operand)
        if kind == 12:
            return (self.random.choice(["JSON.GET", "JSON.TYPE"]), *self.random.choice([(), (f"{place}[*]",)]))
        name = self.random.choice(["GET", "TYPE", "OBJKEYS", "OBJLEN", "ARRLEN", "STRLEN"])
        # The module ends with the server upon the name of a place in an error with a character such as U+4E00.
        return (f"JSON.{name}", place) if place.isascii() or name != "OBJLEN" else ("JSON.OBJKEYS", place)


def plainly(reply):
    """A reply as it is compared: JSON text by what it says, the order of keys and the type of each number included."""
    if isinstance(reply, bytes | bytearray):
        try:
            return orjson.dumps(orjson.loads(reply))
        except orjson.JSONDecodeError:
            return bytes(reply)
    return [plainly(item) for item in reply] if isinstance(reply, list) else repr(reply)


class Comparison:
    """One key of a real server, and the same document as text.

    Args:
        url: A server with the JSON module.
        key: The key there.
    """

    def __init__(self, url, key, seed):
        self.key = key
        self.generator = Generator(seed)
        self.client = redis.Redis.from_url(url, protocol=3)
        self.text = None
        self.refused = 0

    def module(self, commands):
        """Replies of the module to commands, errors as text."""
        with self.client.pipeline(transaction=False) as pipe:
            for name, *words in commands:
                pipe.execute_command(name, self.key, *words)
            return pipe.execute(raise_on_error=False)

    def ours(self, command):
        """The reply of the text; the text is what it is from then on."""
        document = TextDocument(self.text)
        name, *words = command
        try:
            reply = document.run((name, self.key, *words))
        except Refusal as refusal:
            return hiredis.ReplyError(str(refusal))
        if document.changed:
            self.text = document.string() if document.exists else None
        return reply

    def run(self, count):
        """Compare that many commands; return the first difference, None if there is none."""
        for _ in range(count):
            tree = orjson.loads(self.text) if self.text is not None else None
            if self.text is None or len(self.text) > 4000:
                command = ("JSON.SET", "$", settable(orjson.dumps(self.generator.value(4))))
            else:
                command = self.generator.command(tree)
            theirs, whole = self.module([command, ("JSON.GET", "$")])
            ours = self.ours(command)
            if isinstance(theirs, Exception) and isinstance(ours, Exception):
                self.refused += 1
                same = str(theirs).removeprefix("ERR ") == str(ours).removeprefix("ERR ")
            else:
                same = plainly(theirs) == plainly(ours)
            kept = None if self.text is None else b"[" + self.text.removeprefix(MARK) + b"]"
            if not same or (whole is None) != (kept is None) or (kept is not None and plainly(whole) != plainly(kept)):
                return f"{command}\nof {tree!r}\nmodule: {theirs!r}\nours:   {ours!r}\nnow {whole!r}\nand {kept!r}"
        return None


def teach(client):
    """Have a class of redis-py's clients see documents on a plain server as it does where the module is; TYPE, too."""
    send = client.execute_command

    def execute_command(self, *words, **options):
        name = str(words[0]).upper()
        decoded = bool(self.connection_pool.connection_kwargs.get("decode_responses"))
        raw = {redis.client.NEVER_DECODE: True}
        if name == "ACL":  # a server without the module knows no rights to its commands
            words = [word for word in words if not re.match(r"[+-]json\.", str(word))]
        if name == "TYPE":
            kind = send(self, *words, **options)
            is_text = kind in ("string", b"string") and "{" not in redis.utils.str_if_bytes(words[1])
            if is_text and send(self, "GETRANGE", words[1], 0, 0, **raw) == MARK:
                return "ReJSON-RL" if decoded else b"ReJSON-RL"
            return kind
        if not name.startswith("JSON."):
            return send(self, *words, **options)
        kind = send(self, "TYPE", words[1], **raw)
        text = send(self, "GET", words[1], **raw) if kind == b"string" else None
        if kind not in (b"string", b"none") or (text is not None and text[:1] != MARK):
            raise redis.ResponseError("Existing key has wrong Redis type")
        document = TextDocument(text)
        try:
            reply = document.run([name, words[1], *map(_bracketed, words[2:3]), *map(_as_bytes, words[3:])])
        except Refusal as refusal:
            raise redis.ResponseError(str(refusal)) from None
        if document.changed:
            change = ("SET", words[1], document.string(), "KEEPTTL") if document.exists else ("DEL", words[1])
            send(self, *change)
        reply = _as_text(reply) if decoded else reply
        return self.response_callbacks[name](reply) if name in self.response_callbacks else reply

    client.execute_command = execute_command


def _bracketed(path):
    """A path with the dots that people write, as REEM writes it."""
    return re.sub(r"\.([A-Za-z_]\w*)", r'["\1"]', path.decode() if isinstance(path, bytes) else path)


def _as_bytes(word):
    return word if isinstance(word, bytes) else str(word).encode()


def _as_text(reply):
    if isinstance(reply, bytes):
        return reply.decode()
    return [_as_text(item) for item in reply] if isinstance(reply, list) else reply
