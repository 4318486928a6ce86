"""Where the server is and how to log in; making connections with redis-py's own handshake.

redis-py does what is easy to get wrong (AUTH, TLS, SELECT, CLIENT SETINFO). Once it is done, the
transports of this package take the socket over, since its reading and writing are what costs time.
"""

from __future__ import annotations

import codecs
import ipaddress
import os
import re
import socket
import ssl
import struct
import sys
import warnings
from collections.abc import Awaitable, Callable
from typing import Any, TypeVar
from urllib.parse import SplitResult, parse_qsl, urlsplit, urlunsplit

import redis
import redis.asyncio
import redis.exceptions
from redis.asyncio.connection import parse_url

from ..concurrency.timeouts import LONGEST, check_timeout
from ..errors import (
    BadType,
    BadValue,
    ConnectionLost,
    InsecureConnection,
    LoginRefused,
    NotConnected,
    ReemError,
    TlsRefused,
)
from ..plan import Command
from ..plan.replies import refusal
from .protocol import LARGEST, Packer

Address = tuple[str, int]  # host and port

Connection = TypeVar("Connection", bound=Any)  # of either front

INFO_SERVER: Command = ("INFO", "server")
"""Asked once per connection. Restarts are not noticed without the right to it."""

_RUN = re.compile(rb"run_id:([0-9a-f]{8,64})")
_PORT = re.compile(rb"^tcp_port:(\d+)\r?$", re.MULTILINE)
_PID = re.compile(rb"^process_id:(\d+)\r?$", re.MULTILINE)
_SOCKET = re.compile(rb"^listener\d+:name=unix,bind=(/[^,\r\n]+)", re.MULTILINE)
_CREDENTIALS = struct.Struct("3i")  # process, user and group of the listener

for _codec in ("ascii", "idna", "latin-1"):
    # For host names, digests and redis-py: imported by a first connection it may be too late, while Python is shutting
    # down, or in the middle of a fork.
    codecs.lookup(_codec)

_LEAST = 1 << 20  # bytes a string in a reply must be allowed: REEM itself asks for pages of names, and INFO
_TLS_FILES = ("ssl_ca_certs", "ssl_certfile", "ssl_keyfile")


class Options:
    """How to reach one server.

    Args:
        host: A host name, `host:port`, a URL (`redis://`, `rediss://`, `unix://`), or an `EmbeddedServer`.
        timeout: Seconds without a byte moving after which a call is given up.
        options: redis-py's connection options (`port`, `db`, `username`, `password`, `ssl`, ...), and `largest_value`.

    Raises:
        BadValue: A URL that cannot be parsed, or an option that cannot be meant.
        BadType: An option that redis-py does not know.

    Warns:
        InsecureConnection: Others can listen; once for each address.
    """

    def __init__(self, host: Any, timeout: float, options: dict[str, Any]) -> None:
        # What is known of a shorter way to the same server, if one is looked for; else None.
        self.nearby: ServerSocket | None = None
        self.settings = {**settings_of(host), **options}
        limit = self.settings.pop("socket_timeout", timeout)  # redis-py's name for it; None is no limit there
        self.timeout = timeout = LONGEST if limit is None else check_timeout(limit)
        if self.settings.setdefault("protocol", 3) not in (3, "3"):
            raise BadValue("REEM speaks protocol 3 (notices and replies share a connection); leave protocol= out")
        self.largest = _size(self.settings.pop("largest_value", LARGEST))  # bytes that a string in a reply may have
        # A login with TLS takes several round trips, which a time limit for single calls does not mean.
        self.handshake_timeout = max(timeout, 1.0)
        self.tls = bool(self.settings.pop("ssl", False))
        self.socket_path: str | None = self.settings.pop("unix_socket_path", self.settings.pop("path", None))
        if self.socket_path is not None:
            self.settings.pop("host", None)
            self.settings.pop("port", None)
            self.settings["path"] = self.socket_path
        if self.tls:
            self._check_tls()
        try:
            # Made only to have redis-py refuse wrong options now, and not at the first call; nothing is connected.
            self.asynchronous_connection()
            # Its `driver_info` serves all later ones: making one imports, which fails once Python is shutting down.
            self.settings.setdefault("driver_info", self.blocking_connection().driver_info)
        except TypeError as error:
            hint = "; rediss:// turns TLS on" if "ssl_" in str(error) and not self.tls else ""
            unknown = re.search(r"unexpected keyword argument '(\w+)'", str(error))
            problem = f"there is no option {unknown[1]}" if unknown else error
            raise BadType(f"{problem}; see redis-py's connection options{hint}") from None
        except (ValueError, redis.exceptions.RedisError) as error:
            raise BadValue(f"{error}; see redis-py's connection options") from None
        self._warn_of_listeners()

    def _check_tls(self) -> None:
        """Refuse what would only show, in other words, when connecting."""
        if self.socket_path is not None:
            raise BadValue("TLS over a unix socket makes no sense; leave ssl= out")
        lowest = self.settings.setdefault("ssl_min_version", ssl.TLSVersion.TLSv1_2)
        if lowest < ssl.TLSVersion.TLSv1_2:
            raise BadValue(f"ssl_min_version={lowest!r}: TLS before 1.2 is broken; leave it out")
        for name in _TLS_FILES:
            path = self.settings.get(name)
            if path is not None and not os.path.isfile(path):
                raise BadValue(f"{name}={os.fspath(path)!r} is not a file; give the path of one in PEM format")

    def _warn_of_listeners(self) -> None:
        """Say once for each address if what is sent there is open to others; looks nothing up, connects to nothing."""
        if self.socket_path is not None or is_this_machine(str(self.settings.get("host", "localhost"))):
            return
        if not self.tls:
            danger = "is not encrypted: others on the network can read and change data and password"
            remedy = "rediss://"
        elif self.settings.get("ssl_cert_reqs", "required") in ("none", ssl.CERT_NONE):
            danger = "does not check who the server is"
            remedy = "the option ssl_ca_certs, not ssl_cert_reqs"
        else:
            return
        message = (
            f"the connection to {self.address} {danger}; use {remedy} (SECURITY.md says how), or, on a network that "
            "is the robot's own, silence this: "
            "warnings.filterwarnings('ignore', category=reem.InsecureConnection), or PYTHONWARNINGS=ignore::UserWarning"
        )
        if message not in _said:
            _said.add(message)
            warnings.warn(message, InsecureConnection, stacklevel=_levels_to_caller())

    @property
    def database(self) -> int:
        return int(self.settings.get("db") or 0)

    @property
    def address(self) -> str:
        """Where the server is, for messages: never a password."""
        return self.socket_path or f"{self.settings.get('host', 'localhost')}:{self.settings.get('port', 6379)}"

    @property
    def url(self) -> str:
        """What to write to get there, without user and password."""
        if self.socket_path is not None:
            return f"unix://{self.socket_path}" + (f"?db={self.database}" if self.database else "")
        return f"{'rediss' if self.tls else 'redis'}://{self.address}" + (f"/{self.database}" if self.database else "")

    @property
    def connection_class(self) -> str:
        """The name of redis-py's class of connections, which takes `settings`."""
        if self.socket_path is not None:
            return "UnixDomainSocketConnection"
        return "SSLConnection" if self.tls else "Connection"

    def asynchronous_connection(self) -> Any:
        module: Any = redis.asyncio.connection
        # No timeout of redis-py's own: its wait_for can swallow a cancellation before Python 3.12, and it counts what
        # other tasks of the loop do.
        settings = {"socket_timeout": None, "socket_connect_timeout": None, **self.settings}
        return _greeted(getattr(module, self.connection_class)(**settings))

    def blocking_connection(self) -> Any:
        module: Any = redis.connection
        # redis-py's time limit is for the handshake only; then the transport sets its own on the socket.
        limit = self.handshake_timeout
        settings = {"socket_timeout": limit, "socket_connect_timeout": limit, "command_packer": Packer()}
        return getattr(module, self.connection_class)(**(settings | self.settings))

    def refused(self, error: Exception) -> Exception:
        """Return the error to raise when connecting failed with `error`; it never shows what was sent."""
        if isinstance(error, ReemError):
            return error
        reason = _reason(error)
        if isinstance(reason, ssl.SSLError):
            return TlsRefused(f"no TLS connection to {self.address}: {_tls_remedy(reason)}")
        if self.tls and (isinstance(reason, ConnectionResetError) or "closed by server" in str(error)):
            return TlsRefused(f"no TLS connection to {self.address}: it was closed at once; {_CERTIFICATE}")
        text = self._without_password(str(error))
        code = "NOAUTH" if "HELLO must be called" in text else getattr(error, "status_code", None)
        # redis-py takes the code off the texts of errors that it knows, and keeps it in `status_code`.
        told = refusal(f"{code} {text}") if code else refusal(text)
        if told is None and isinstance(error, redis.exceptions.AuthenticationError):
            told = LoginRefused(f"the login was refused: {text}")
        if told is not None:
            return told.at(self.address)
        if "max number of clients" in text:
            return NotConnected(
                f"the server at {self.address} has as many clients as its `maxclients` allows; close connections that "
                "are not needed (`CLIENT LIST` shows them), or raise `maxclients`"
            )
        if isinstance(error, redis.exceptions.ResponseError):
            return NotConnected(
                f"the server at {self.address} does not take the greeting ({text:.200}); "
                "REEM needs Redis 7, or Valkey, or newer"
            )
        return NotConnected(
            f"no server answers at {self.address} ({_shown(reason, text)}); start one with `reem up` or with "
            f"compose.yaml, or give the right address: redis://host:port (on the command line by "
            f"--url or REEM_URL){self._hint(reason)}"
        )

    def unanswered(self, error: ConnectionLost) -> NotConnected:
        """Return the error to raise where a new connection broke at its first question: no call had been sent."""
        reason = str(error).partition("; the call")[0]
        return NotConnected(
            f"the server at {self.address} accepted the connection, but the first request failed: {reason}; "
            "nothing was applied"
        )

    def _hint(self, reason: BaseException) -> str:
        """Return what may be the matter besides, given that the address is right."""
        if self.tls:
            silent = isinstance(reason, TimeoutError | redis.exceptions.TimeoutError)
            return "; if what listens there does not speak TLS, use redis:// or its port for TLS" if silent else ""
        refused = isinstance(reason, OSError) and not isinstance(reason, ConnectionResetError)
        return "" if refused else "; if it speaks TLS only, use rediss://"

    def _without_password(self, text: str) -> str:
        """Return an error's text, or a word in its place if the server quotes the login in it."""
        # Servers quote the words of a command that they do not know; those of AUTH are the password.
        text = text.partition("with args beginning")[0]
        secret = self.settings.get("password")
        return "its answer quotes the password" if secret and str(secret) in text else text


def _greeted(connection: Any) -> Any:
    """Have a connection of redis.asyncio look at the reply to HELLO, its first one, as redis-py's blocking one does.

    And keep it, under the same name.
    """
    read = connection.read_response

    async def first(*args: Any, **kwargs: Any) -> Any:
        connection.read_response = read
        greeting = await read(*args, **kwargs)
        # A proxy, or an old server, that answers in another protocol: its replies would be read wrong.
        if not isinstance(greeting, dict) or 3 not in (greeting.get(b"proto"), greeting.get("proto")):
            raise redis.exceptions.ConnectionError("Invalid RESP version")
        connection.handshake_metadata = greeting
        return greeting

    connection.read_response = first
    return connection


class NodeOptions(Options):
    def __init__(self, of: Options, address: Address, settings: dict[str, Any] | None = None) -> None:
        host, port = address
        settings = of.settings if settings is None else settings
        super().__init__(
            host, of.timeout, {**settings, "host": host, "port": port, "ssl": of.tls, "largest_value": of.largest}
        )

    def _warn_of_listeners(self) -> None:
        """Say nothing: it was said of them all."""


def _size(given: Any) -> int:
    """Return the limit for strings in replies that was given: an int, or digits in a URL; raises BadValue."""
    size = int(given) if isinstance(given, str) and given.isascii() and given.isdigit() else given
    if type(size) is not int or size < _LEAST:
        raise BadValue(f"largest_value={given!r} is not a number of bytes of at least {_LEAST}")
    return size


_CERTIFICATE = (
    "if it asks clients for certificates, give one that it trusts, with its key: the options ssl_certfile and "
    "ssl_keyfile (in the URL: ?ssl_certfile=FILE&ssl_keyfile=FILE)"
)

_said: set[str] = set()


def _levels_to_caller() -> int:
    """Return the stack level, for warnings.warn, of the first caller outside of REEM."""
    frame, level = sys._getframe(1), 1
    while frame.f_back is not None and str(frame.f_globals.get("__name__")).partition(".")[0] in ("reem", "reem_async"):
        frame, level = frame.f_back, level + 1
    return level


def is_this_machine(host: str) -> bool:
    """Return whether a name stands for this very machine, as far as can be told without looking it up."""
    if host in ("", "localhost") or host.endswith(".localhost"):
        return True
    try:
        address = ipaddress.ip_address(host)
    except ValueError:
        return False
    address = getattr(address, "ipv4_mapped", None) or address
    return address.is_loopback or address.is_unspecified


def _reason(error: BaseException) -> BaseException:
    """Return what is behind an error of redis-py: the TLS error or the operating system's, else itself."""
    # redis-py wraps some errors with `from` and some without.
    chain, link = [error], error.__cause__ or error.__context__
    while link is not None and link not in chain:
        chain.append(link)
        link = link.__cause__ or link.__context__
    for kind in (ssl.SSLError, OSError):
        for each in chain:
            if isinstance(each, kind):
                return each
    return error


def _tls_remedy(reason: ssl.SSLError) -> str:
    """Return what went wrong in a TLS handshake, and what to do."""
    if isinstance(reason, ssl.SSLCertVerificationError):
        said = reason.verify_message
        if "ostname mismatch" in said or "IP address mismatch" in said:
            return f"{said.rstrip('.')}; connect by a name that is in the certificate, or issue one with this name"
        if "expired" in said or "not yet valid" in said:
            return f"the server's {said}; renew it, or set the clock right"
        return f"the server's certificate is not trusted ({said}); give its authority's: ?ssl_ca_certs=FILE"
    name = reason.reason or str(reason)
    if "WRONG_VERSION_NUMBER" in name or "PACKET_LENGTH" in name:
        return f"what answers there does not speak TLS ({name}); use redis:// or the TLS port"
    if "EOF" in name:
        return f"the server closed it at once ({name}); {_CERTIFICATE}"
    if "ALERT" in name and "PROTOCOL" not in name:
        return f"the server refuses this client ({name}); {_CERTIFICATE}"
    return f"{name}; server and client need TLS 1.2 or newer and certificates in PEM format"


def _shown(reason: BaseException, text: str) -> str:
    if isinstance(reason, OSError) and reason.errno is not None:
        return os.strerror(reason.errno) if reason.errno > 0 else str(reason)
    return f"{text:.200}" or type(reason).__name__


def server_run_id(introduction: Any) -> str | None:
    # A user without the right gets an error: restarts are then not noticed, and all else goes on.
    found = _RUN.search(introduction) if isinstance(introduction, bytes | bytearray) else None
    return None if found is None else found[1].decode()


def look_nearby(options: Options) -> None:
    """Have connections look for the server's Unix socket first.

    Only where the address is that of one server on this machine, without TLS, and only on systems
    that tell which process listens at a socket. Nothing is connected yet.
    """
    host = str(options.settings.get("host", "localhost"))
    plain = type(options) is Options and not options.tls and options.socket_path is None
    if plain and is_this_machine(host) and hasattr(socket, "SO_PEERCRED"):
        options.nearby = ServerSocket(options)


class ServerSocket:
    """The Unix socket of the server at an address, as far as it is known."""

    def __init__(self, options: Options) -> None:
        self._options = options
        self._vain: str | None = None
        # How to reach it through the socket; None as long as none is known, or of use.
        self.way: SocketOptions | None = None

    def _learn(self, introduction: Any) -> None:
        """Note what the server at the address says of itself, asked who it is.

        Where its port is another one, something stands in between, on purpose: a tunnel, or a proxy.
        """
        process = server_run_id(introduction)
        # The socket of this process was tried and does not work (another container, no right to it): not again.
        if process is None or process == self._vain:
            return
        port, pid, path = (pattern.search(introduction) for pattern in (_PORT, _PID, _SOCKET))
        if port and pid and path and int(port[1]) == int(self._options.settings.get("port", 6379)):
            self.way = SocketOptions(self._options, os.fsdecode(path[1]), process, int(pid[1]))

    async def connected(self, connect: Callable[[Options], Awaitable[Connection]]) -> Connection:
        """Return a new connection that `connect` makes: through the socket, if it is found."""
        by_socket = await self._through(connect)
        if by_socket is not None:
            return by_socket
        connection = await connect(self._options)
        # Only the server itself says where its socket is, so the first connection always goes to the address.
        self._learn(connection.introduction)
        try:
            by_socket = await self._through(connect)
        except BaseException:
            await connection.discard()
            raise
        if by_socket is None:
            return connection
        await connection.discard()
        return by_socket

    async def _through(self, connect: Callable[[Options], Awaitable[Connection]]) -> Connection | None:
        way = self.way
        if way is None:
            return None
        try:
            return await connect(way)
        except ReemError as error:
            # A server that does not answer in time will not at its address either.
            if isinstance(error.__cause__, TimeoutError | redis.exceptions.TimeoutError):
                raise
            # As long as the same process is at the address, its socket is not tried again.
            self._vain, self.way = way.process, None
            return None


class SocketOptions(Options):
    """How to reach a server through its Unix socket, and no other one: the login is for this process alone."""

    def __init__(self, by_address: Options, path: str, process: str, pid: int) -> None:
        self._by_address = by_address.address
        self.process = process  # what the server's process calls itself
        self._pid = pid
        settings = {name: value for name, value in by_address.settings.items() if not name.startswith("socket_keepa")}
        settings.pop("socket_type", None)
        super().__init__(
            "localhost", by_address.timeout, settings | {"unix_socket_path": path, "largest_value": by_address.largest}
        )

    @property
    def address(self) -> str:
        return self._by_address

    def asynchronous_connection(self) -> Any:
        connection = super().asynchronous_connection()
        log_in = connection.on_connect_check_health

        async def check_first(**options: Any) -> None:
            # Before AUTH is sent: another process that listens at the path must not get the password.
            self._check_listener(connection._writer.get_extra_info("socket"))
            await log_in(**options)

        connection.on_connect_check_health = check_first
        return connection

    def blocking_connection(self) -> Any:
        connection = super().blocking_connection()
        log_in = connection.on_connect_check_health

        def check_first(**options: Any) -> None:
            self._check_listener(connection._sock)  # before AUTH is sent, as above
            log_in(**options)

        connection.on_connect_check_health = check_first
        return connection

    def _check_listener(self, listening: Any) -> None:
        """Raise redis.exceptions.ConnectionError if another process listens there: it gets no password."""
        with socket.socket(fileno=os.dup(listening.fileno())) as connected:
            # A copy of the descriptor: closing this socket object must not close the connection.
            told = connected.getsockopt(socket.SOL_SOCKET, socket.SO_PEERCRED, _CREDENTIALS.size)
        if _CREDENTIALS.unpack(told)[0] != self._pid:
            raise redis.exceptions.ConnectionError("another process listens at the server's socket")


_SCHEMES = ("redis://", "rediss://", "unix://")


def settings_of(host: Any) -> dict[str, Any]:
    socket_path = getattr(host, "socket_path", None)
    if socket_path is not None:
        password = getattr(host, "password", None)
        return {"unix_socket_path": str(socket_path)} | ({"password": password} if password else {})
    if not isinstance(host, str):
        raise BadType(f"host is a name, a URL or an EmbeddedServer, not {type(host).__name__}")
    if "://" not in host:
        if "@" in host:
            raise BadValue("host is a name alone; user and password go in username=, password= or in a URL, redis://")
        return _host_and_port(host)
    if not host.startswith(_SCHEMES):
        raise BadValue(f"the URL of a server begins with one of {', '.join(_SCHEMES)}")
    try:
        _check_url(host)
        settings: dict[str, Any] = {**parse_url(host)}
    except BadValue:  # it names the part that is wrong
        raise
    except ValueError:  # its text may hold a part of the password
        raise BadValue(
            "the URL of the server is wrong; write it like redis://user:password@host:6379/0, special characters "
            "of the password percent-encoded"
        ) from None
    if settings.pop("connection_class", None) is redis.asyncio.connection.SSLConnection:
        settings["ssl"] = True
    return settings


def _host_and_port(host: str) -> dict[str, Any]:
    """Return the connection settings of `host`, `host:port`, `[IPv6]:port`, or an IPv6 address alone."""
    if ":" not in host or (host.count(":") > 1 and not host.startswith("[")):
        return {"host": host}
    try:
        parts = urlsplit(f"//{host}")
        if parts.netloc == host and parts.hostname and parts.port:
            return {"host": parts.hostname, "port": parts.port}
    except ValueError:
        pass
    raise BadValue(f"{host!r} is not a host with a port; write it like localhost:6379 or [::1]:6379")


def _check_url(url: str) -> None:
    """Refuse the parts of a server's URL that redis-py drops in silence: another server would be meant.

    Raises BadValue, whose message never quotes user and password.
    """
    parts = _split(url)
    login, _, place = parts.netloc.rpartition("@")
    problem, form = "", f"{parts.scheme}://{'user:password@' if login else ''}host:6379/0"
    if parts.scheme == "unix":
        form = "unix:///run/redis.sock?db=0"
        if place:
            problem = f"{place!r} stands in the place of a host; a path begins with three slashes"
        elif parts.path in ("", "/"):
            problem = "it has no path of a socket"
    elif not re.fullmatch(r"/?|/[0-9]+/?", parts.path):
        problem = f"{parts.path!r} is not the number of a database"
    elif "," in place:
        problem, form = (
            "it lists several hosts",
            "redis+cluster://host:7000,host:7001 or redis+sentinel://host:26379/name",
        )
    elif place.endswith((":", ":0")) or re.search(r"\s", place):
        problem = f"{place!r} is not a host with a port"
    if "#" in url.rpartition("@")[2]:
        problem = "it has a fragment (#...)"
    databases = [value for name, value in parse_qsl(parts.query, keep_blank_values=True) if name == "db"]
    if any(not re.fullmatch("[0-9]+", value) for value in databases):
        problem = f"db={databases[0]!r} is not the number of a database"
    elif len({*databases, parts.path.strip("/") if parts.scheme != "unix" else ""} - {""}) > 1:
        problem = "it names two databases"
    if problem:
        raise BadValue(f"the URL of the server is wrong: {problem}; write it like {form}")


def _split(url: str) -> SplitResult:
    """Return the parts of a URL; raise BadValue for one with half an IPv6 address, and never quote it."""
    try:
        return urlsplit(url)
    except ValueError:
        raise BadValue("the URL of the server is wrong: an IPv6 address is written like redis://[::1]:6379/0") from None


def address_of(url: str, port: int) -> tuple[str, int]:
    parts = urlsplit(url)
    return parts.hostname or "localhost", parts.port or port


def listed(url: str, example: str) -> list[str]:
    """Return a URL that lists several hosts as one plain URL for each: redis+x://u@a:1,b:2/c as redis://u@a:1/c, ...

    Raises:
        BadValue: No host, or a port that is no number; never quotes the URL, which may hold a password.
    """
    parts = _split(url)
    if parts.fragment:
        raise BadValue(f"the URL has a fragment (#...); write it like {example}")
    # From the right: a password may contain an @.
    login, at, hosts = parts.netloc.rpartition("@")
    if "," in login.partition("@")[2]:
        raise BadValue(f"the URL has a user for each host; one user has all hosts, write it like {example}")
    urls = []
    for each in hosts.split(","):
        try:
            one = urlsplit(f"//{each}")
            sound = bool(one.hostname) and (one.port is None or one.port > 0)
        except ValueError:
            sound = False
        if not sound:
            raise BadValue(f"{each!r} is not a host with a port; write it like {example}")
        urls.append(urlunsplit((parts.scheme.partition("+")[0], login + at + each, parts.path, parts.query, "")))
    return urls
