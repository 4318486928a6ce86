"""Datagrams between programs of one user on one host, ahead of the server.

A publisher with `local="early"` has a mailbox, and so has each subscriber's event loop that such a publisher has asked.
A mailbox is a Unix socket in a folder that only the user can enter, and the kernel names the user of each sender.

    subscriber -- JOINED channel ------------------> all publishers    it has subscribed to channel@host at the server
    publisher  -- PUBLISH channel@host address ----> the server        so that only subscribers on this server answer
    subscriber -- FOLLOWS channel address ---------> that publisher
    publisher  -- UPDATE channel notice -----------> those subscribers

The first update in a segment, and then one a second, carries the descriptor of that memory, so that a subscriber need
not find it in `/proc`. What is lost here, or arrives late, arrives through the server as well.
"""

from __future__ import annotations

import collections
import contextlib
import logging
import os
import re
import secrets
import socket
import stat
import struct
import time
import weakref
from typing import NamedTuple

from ..concurrency.locks import Descriptor, Inherited
from .segment import host

logger = logging.getLogger("reem.publish")

JOINED, FOLLOWS, UPDATE = b"J", b"F", b"U"
PUBLISHER, SUBSCRIBER = "p", "s"

_LARGEST = 1 << 17  # bytes of a datagram: twice the largest value that is not in a slot; Linux sends up to 200,000
_ANSWER = 1 << 11  # bytes of a datagram for a publisher: the name of a channel and an address
_HEAD = struct.Struct("!cH")  # the kind, and the bytes of the channel
_CREDENTIALS = struct.Struct("3i")  # struct ucred of <sys/socket.h>: process, user, group
_DESCRIPTOR = struct.Struct("i")
_ANCILLARY = socket.CMSG_SPACE(_CREDENTIALS.size) + socket.CMSG_LEN(_DESCRIPTOR.size)
"""Room for the user and one descriptor: the kernel closes further ones, and says that something is missing."""
_ADDRESS = re.compile(r"[0-9a-f]{16}[ps][0-9a-f]{16}")
_HOST = 16  # characters of an address that name its host
_PARENT = "/tmp"  # noqa: S108 - the owner of what is below is checked
_ANSWERED = 2.5  # seconds for which the answer of a subscriber holds: publishers ask each second
_CHANNELS = 1000  # of one publisher, whose subscribers are remembered
_SUBSCRIBERS = 256  # of one channel that are notified early
_INVALID = 100  # datagrams that are skipped at a time
_CLOSE_ON_EXEC = int(socket.MSG_CMSG_CLOEXEC)  # an int: Python computes with flags of an enum ten times slower
_TRUNCATED = int(socket.MSG_TRUNC | socket.MSG_CTRUNC)


class Datagram(NamedTuple):
    kind: bytes
    channel: bytes
    content: bytes
    memory: Descriptor | None = None  # of a segment, or of anything: the receiver has to check it


class Mailbox:
    """A datagram socket of this process.

    Args:
        role: PUBLISHER or SUBSCRIBER.

    Raises:
        OSError: No descriptor is left, or another user owns the folder.

    Attributes:
        address: Its name in the folder.
        descriptor: Readable when a datagram has arrived.
        close: Closes it and removes its file; idempotent. Called when the mailbox is dropped, and in a forked child.
    """

    def __init__(self, role: str) -> None:
        self._folder = _folder()
        _remove_dead(self._folder)
        self.address = f"{host()}{role}{secrets.token_hex(8)}"
        path = f"{self._folder}/{self.address}"
        self._socket = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM | socket.SOCK_CLOEXEC | socket.SOCK_NONBLOCK)
        self.descriptor = self._socket.fileno()
        owner = Descriptor(self.descriptor)
        self.close = weakref.finalize(self, _close, self._socket, owner, path, os.getpid())
        self._socket.setsockopt(socket.SOL_SOCKET, socket.SO_PASSCRED, 1)
        self._socket.bind(path)
        # Kept, since memory of that size comes from the system each time. Only an event loop reads it.
        self._buffer = bytearray(_LARGEST) if role == SUBSCRIBER else None
        _all.add(self)

    @property
    def is_there(self) -> bool:
        """Whether others can find it: it is open, and its file was not removed, as when a program empties /tmp."""
        return self.close.alive and os.path.exists(f"{self._folder}/{self.address}")

    def try_send(
        self, address: str, kind: bytes, channel: bytes, content: bytes = b"", memory: Descriptor | None = None
    ) -> None:
        """Send without waiting; raises OSError, which is a BlockingIOError if the receiver's queue is full."""
        rights: list[tuple[int, int, bytes]] = []
        if memory is not None and memory.is_own:
            rights.append((socket.SOL_SOCKET, socket.SCM_RIGHTS, _DESCRIPTOR.pack(memory.number)))
        self._socket.sendmsg([_HEAD.pack(kind, len(channel)), channel, content], rights, 0, f"{self._folder}/{address}")

    def send(
        self, address: str, kind: bytes, channel: bytes, content: bytes = b"", memory: Descriptor | None = None
    ) -> bool:
        """Send without waiting; return False if that address does not exist any more."""
        try:
            self.try_send(address, kind, channel, content, memory)
        except (ConnectionRefusedError, FileNotFoundError):
            return False
        except OSError:  # its queue is full, this mailbox is closed, or the system has no memory for it now
            pass
        return True

    def receive(self) -> Datagram | None:
        """Return the next valid datagram of the same user; None if there is none."""
        buffer = bytearray(_ANSWER) if self._buffer is None else self._buffer  # threads share a publisher's
        for _ in range(_INVALID):
            try:
                size, ancillary, flags, _ = self._socket.recvmsg_into([buffer], _ANCILLARY, _CLOSE_ON_EXEC)
            except OSError:
                return None
            memory = _received(ancillary) if len(ancillary) > 1 else None  # closed unless it is returned
            users = [_CREDENTIALS.unpack(data)[1] for _, kind, data in ancillary if kind == socket.SCM_CREDENTIALS]
            if users == [os.getuid()] and size >= _HEAD.size and not flags & _TRUNCATED:
                kind, length = _HEAD.unpack_from(buffer)
                end = _HEAD.size + length
                if end <= size:
                    return Datagram(kind, bytes(buffer[_HEAD.size : end]), bytes(memoryview(buffer)[end:size]), memory)
        return None


def _received(ancillary: list[tuple[int, int, bytes]]) -> Descriptor | None:
    for number in [_DESCRIPTOR.unpack(data)[0] for _, kind, data in ancillary if kind == socket.SCM_RIGHTS and data]:
        try:
            return Descriptor(number)
        except OSError:  # of a file system that is gone
            with contextlib.suppress(OSError):
                os.close(number)
    return None


_all = Inherited[Mailbox](lambda mailbox: mailbox.close())


def _close(owner: socket.socket, descriptor: Descriptor, path: str, process: int) -> None:
    owner.detach()  # the descriptor is closed with the last reference to its `Descriptor`
    if os.getpid() == process:  # the file is not a forked child's
        with contextlib.suppress(OSError):
            os.unlink(path)


def _path() -> str:
    # Not $XDG_RUNTIME_DIR: services that the system starts have none, and it is removed when the user logs out.
    return f"{_PARENT}/reem-{os.getuid()}"


def _folder() -> str:
    """Return the folder of the mailboxes, made if need be; raises OSError if others than this user can enter it."""
    folder = _path()
    with contextlib.suppress(FileExistsError):
        os.mkdir(folder, 0o700)
    found = os.lstat(folder)
    if not stat.S_ISDIR(found.st_mode) or found.st_uid != os.getuid() or found.st_mode & 0o077:
        raise OSError(f"{folder} is not a folder of this user alone; run: chmod 700 {folder}")
    return folder


def _remove_dead(folder: str) -> None:
    for name in os.listdir(folder):
        if not is_address(name):
            continue
        with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as probe:
            try:
                probe.connect(f"{folder}/{name}")
            except ConnectionRefusedError:  # its process has ended: a file is bound as soon as it exists
                with contextlib.suppress(OSError):
                    os.unlink(f"{folder}/{name}")
            except OSError:
                pass


def _addresses() -> list[str]:
    try:
        return [name for name in os.listdir(_path()) if is_address(name)]
    except OSError:  # there has been no early publisher, or the folder is another user's
        return []


def publishers() -> list[str]:
    return [name for name in _addresses() if name[_HOST:].startswith(PUBLISHER)]


def hosts() -> set[str]:
    """Return the hosts that have mailboxes here: containers may share the folder, though each is a host by itself."""
    return {name[:_HOST] for name in _addresses()}


def mounted() -> bool:
    """Return whether the folder is mounted, as in a container that shares it."""
    return os.path.ismount(_path())


def is_address(text: str) -> bool:
    return _ADDRESS.fullmatch(text) is not None


class Subscribers:
    """The subscribers near an early publisher, by channel."""

    def __init__(self) -> None:
        self._mailbox: Mailbox | None = None
        self._reported = ""  # the last warning
        # By channel, in the order in which they were first asked for: until when the answer of each address holds, and
        # the inode of the segment that was passed to it since
        self._known: collections.OrderedDict[bytes, dict[str, tuple[float, int]]] = collections.OrderedDict()

    def ask(self, channel: bytes) -> bytes:
        """Return the address at which the subscribers of a channel are to answer; empty if there is none now."""
        if self._mailbox is None or not self._mailbox.is_there:  # a forked child needs its own
            try:
                self._mailbox = Mailbox(PUBLISHER)
            except OSError as error:
                if str(error) != self._reported:
                    self._reported = str(error)
                    logger.warning("early updates are not possible here, all go through the server: %s", error)
                return b""
        self._known.setdefault(channel, {})
        while len(self._known) > _CHANNELS:
            self._known.popitem(last=False)
        return self._mailbox.address.encode()

    def take_answers(self) -> list[bytes]:
        """Note the answers that have arrived; return the channels that a subscriber has joined."""
        joined: list[bytes] = []
        mailbox = self._mailbox  # another thread may close the interface meanwhile
        while mailbox is not None and (it := mailbox.receive()) is not None:
            address, known = it.content.decode(errors="replace"), self._known.get(it.channel)
            if it.kind == JOINED:
                joined.append(it.channel)
            elif it.kind == FOLLOWS and known is not None and is_address(address):
                known[address] = time.monotonic() + _ANSWERED, 0
                if len(known) > _SUBSCRIBERS:
                    del known[address]
        return joined

    def count(self, channel: bytes) -> int:
        return len(self._known.get(channel, ()))

    def notify(self, channel: bytes, notice: bytes, memory: Descriptor | None) -> None:
        """Send an update to the subscribers of a channel; `memory` is that of the segment it is in, if any."""
        known, mailbox, now = self._known.get(channel, {}), self._mailbox, time.monotonic()
        if mailbox is None or len(notice) > _LARGEST - _HEAD.size - len(channel):
            return
        for address, (until, passed) in [*known.items()]:
            new = None if memory is None or memory.inode == passed else memory
            if until < now or not mailbox.send(address, UPDATE, channel, notice, new):
                known.pop(address, None)
            elif new is not None:
                known[address] = until, new.inode
        # Where cores are few, a subscriber that was just woken goes first: the server can wait (a sixth of the time).
        os.sched_yield()

    def close(self) -> None:
        if self._mailbox is not None:
            self._mailbox.close()
        self._mailbox = None
        self._known.clear()
