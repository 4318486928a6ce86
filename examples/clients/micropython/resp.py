"""A connection to a Redis server, with the modules that MicroPython has. RESP3: messages are in order with replies."""

import select
import socket

LARGEST = 1 << 29  # bytes of a reply, or items: what no server sends to this client


class Failure(Exception):
    """What the caller has to know, in one line."""


def check(ok, why):
    """Raise Failure unless `ok`."""
    if not ok:
        raise Failure(why)


class Connection:
    """One connection: replies, and the messages of channels."""

    def __init__(self, url):
        scheme, _, rest = url.partition("://")
        check(scheme == "redis", "the URL is not like redis://[user:password@]host[:port]")
        account, _, address = rest.rpartition("@")
        address, _, database = address.partition("/")
        host, _, port = address.partition(":")
        check(database in ("", "0"), "this client uses database 0 only")
        self.received, self.messages = b"", []  # bytes that are not read yet; messages that are not handled yet
        self.socket = socket.socket()
        self.socket.settimeout(5)
        self.socket.connect(socket.getaddrinfo(host, int(port or 6379), 0, socket.SOCK_STREAM)[0][-1])
        self.poll = select.poll()
        self.poll.register(self.socket, select.POLLIN)
        user, _, password = account.partition(":")
        hello = self.send("HELLO", "3", *(["AUTH", user or "default", password] if account else []))
        mode = hello[hello.index(b"mode") + 1] if b"mode" in hello else b"standalone"
        check(mode == b"standalone", f"this is not a single server, but: {mode.decode()}")
        kind = self.send("JSON.TYPE", "_", refusals=True)
        self.has_json = not isinstance(kind, Failure)  # a server without the JSON module holds documents as text
        is_unknown = self.has_json or str(kind).startswith("ERR unknown command")
        check(is_unknown, f"the server refused JSON.TYPE: {kind}")

    def send(self, *words, confirmed=b"", refusals=False):
        """Send a command and return its reply; with `refusals` an error of the server is returned, not raised."""
        words = [word.encode() if isinstance(word, str) else word for word in words]
        lengths = [b"$" + str(len(word)).encode() + b"\r\n" + word + b"\r\n" for word in words]
        self.socket.sendall(b"*" + str(len(words)).encode() + b"\r\n" + b"".join(lengths))
        while True:
            is_push, found = self.next()
            if not is_push or found[0] == confirmed:
                check(refusals or not isinstance(found, Failure), f"the server refused {words[0].decode()}: {found}")
                return found

    def subscribe(self, channel):
        """Subscribe; all messages from now on are kept in `messages`."""
        self.send("SUBSCRIBE", channel, confirmed=b"subscribe")

    def wait(self, seconds):
        """Return the next message, or None if there is none for so long."""
        if not self.messages and (self.received or self.poll.poll(int(max(seconds, 0) * 1000))):
            check(self.next()[0], "the server sent a reply to no command")
        return self.messages.pop(0) if self.messages else None

    def next(self):
        if not self.received:
            self.more()
        is_push = self.received[:1] == b">"
        found = self.frame(0)
        check(not is_push or found, "the server sent an empty message")
        if is_push and found[0] == b"message":
            check(len(found) == 3 and isinstance(found[2], bytes), "the server sent a message without content")
            self.messages.append(found[2])
        return is_push, found

    def frame(self, depth):
        while b"\r\n" not in self.received:
            check(len(self.received) < 1 << 16, "the server sent a line without an end")
            self.more()
        line, self.received = self.received.split(b"\r\n", 1)
        kind, text = line[:1], line[1:]
        check(depth < 8 and kind and kind in b"+-:_,#$=*~>%", f"the server sent {line[:40]!r}, which is no reply")
        if kind in b"-+_,#":
            return Failure(text.decode()) if kind == b"-" else None if kind == b"_" else text
        count = int(text)
        if kind == b":" or count == -1:
            return count if kind == b":" else None
        check(0 <= count <= LARGEST, "the server sent a reply of %d bytes or items" % count)
        if kind in b"*~>%":
            return [self.frame(depth + 1) for _ in range(count * (2 if kind == b"%" else 1))]
        pieces, missing = [self.received], count + 2 - len(self.received)
        while missing > 0:
            self.received = b""
            self.more()
            pieces.append(self.received)
            missing -= len(self.received)
        whole = b"".join(pieces)
        check(whole[count : count + 2] == b"\r\n", "the server sent a text of another length than it said")
        self.received = whole[count + 2 :]
        return whole[:count]

    def more(self):
        piece = self.socket.recv(1 << 12)  # more at once would cut a small heap into pieces
        check(piece, "the server closed the connection")
        self.received += piece
