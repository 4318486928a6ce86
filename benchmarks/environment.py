"""Interpreters for contenders that cannot share ours, and the line that says where figures were taken."""

import contextlib
import importlib.metadata
import os
import pathlib
import platform
import subprocess
import sys

FOLDER = pathlib.Path(__file__).resolve().parent
CACHE = FOLDER / ".cache"

# rejson 0.5.6 is the last one; it asks for redis-py below 4. numpy is the one we have ourselves.
_ORIGINAL = ["rejson==0.5.6", "redis==3.5.3", "six", f"numpy=={importlib.metadata.version('numpy')}"]
_NUMPY = f"numpy=={importlib.metadata.version('numpy')}"
PRIVATE = {
    "reem-0.1.2": ["reem==0.1.2", *_ORIGINAL],
    "reem-0.0.11": ["reem==0.0.11", *_ORIGINAL],
    # Where there is no wheel (Linux on ARM, an older glibc) it is left out, not built.
    "iceoryx2": ["--only-binary=iceoryx2", "iceoryx2==0.10.0", "orjson", _NUMPY],
}


class VenvError(Exception):
    """A private virtual environment could not be made."""


def interpreter(name: str | None) -> str:
    """The interpreter of a private environment, made on first use; ours if no name is given."""
    if name is None:
        return sys.executable
    folder, wanted = CACHE / name, PRIVATE[name]
    python, ready = folder / "bin" / "python", folder / "requirements.txt"
    if ready.exists() and ready.read_text().splitlines() == wanted:
        return str(python)
    _run([sys.executable, "-m", "venv", "--clear", str(folder)])
    _run([str(python), "-m", "pip", "install", "--quiet", "--disable-pip-version-check", *wanted])
    ready.write_text("\n".join(wanted) + "\n")
    return str(python)


def at_commit(commit: str) -> list[str]:
    """What an environment needs to have REEM as it was at a commit, with the libraries that we have."""
    others = [f"{name}=={importlib.metadata.version(name)}" for name in ("redis", "hiredis", "numpy", "orjson")]
    return [f"git+file://{FOLDER.parent}@{commit}#egg=reem", *others]


def _run(command: list[str]) -> None:
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    if done.returncode:
        raise VenvError(f"{' '.join(command[:4])}: {done.stderr.strip().splitlines()[-1:]}")


def processor() -> str:
    """The processor's name."""
    with contextlib.suppress(OSError):
        for line in pathlib.Path("/proc/cpuinfo").read_text().splitlines():
            if line.startswith("model name"):
                return line.split(":", 1)[1].strip()
    return platform.processor() or platform.machine()


def cores() -> int:
    """How many cores we may use."""
    with contextlib.suppress(AttributeError):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1


def line(server_version: str) -> str:
    """The environment in one line."""
    packages = ", ".join(
        f"{name} {importlib.metadata.version(name)}" for name in ("redis", "hiredis", "numpy", "orjson")
    )
    python = f"{platform.python_implementation()} {platform.python_version()}"
    machine = f"{processor()}, {cores()} cores; {platform.system()} {platform.release()}"
    return f"{machine}; {python}; {packages}; {server_version}"
