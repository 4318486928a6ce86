"""The package: what is installed beside it, what its metadata says, and the private names of redis-py that it uses."""

import os
import re
import subprocess
import sys
from importlib import metadata

import pytest
from conftest import ROOT

import reem_async

CLASH = "the original reem 0.1.2 is installed beside reem-async: their files are mixed"
CURE = "pip uninstall -y reem reem-async && pip install reem-async"


def beside_the_original(folder, code):
    """Run code with REEM installed in `folder`, where a dist-info says that the original is installed, too."""
    for package in ("reem", "reem_async"):
        (folder / package).symlink_to(ROOT / package)
    (folder / "reem-0.1.2.dist-info").mkdir()
    environment = os.environ | {"PYTHONPATH": str(folder), "REEM_URL": "redis://127.0.0.1:1"}
    return subprocess.run(
        [sys.executable, "-c", code],
        cwd=folder,
        env=environment,
        capture_output=True,
        text=True,
        timeout=60,
        check=False,
    )


def test_importing_beside_the_original_warns(tmp_path):
    done = beside_the_original(tmp_path, "import reem")
    assert f"RuntimeWarning: {CLASH}; run: {CURE}\n" in done.stderr


@pytest.mark.parametrize("its_redis_py", [False, True])
def test_the_doctor_fails_beside_the_original(tmp_path, its_redis_py):
    if its_redis_py:
        (tmp_path / "redis.py").write_text("")
    done = beside_the_original(
        tmp_path, "import sys; from reem_async.tools.cli import main; sys.argv = ['reem', 'doctor']; main()"
    )
    assert done.returncode == 1
    assert done.stderr == f"reem: {CLASH}; run: {CURE}\n"
    assert its_redis_py or f"fail\tinstallation\t{CLASH}\t{CURE}\n" in done.stdout


def test_version_and_extras_are_those_of_the_distribution():
    about = metadata.metadata("reem-async")
    assert about["Version"] == reem_async.__version__
    texts = [
        file.read_text(encoding="utf-8") for folder in ("reem", "reem_async") for file in (ROOT / folder).rglob("*.py")
    ]
    named = {
        extra
        for text in texts
        for extras in re.findall(r"reem-async\[([a-z,]+)\]", text)
        for extra in extras.split(",")
    }
    assert {"server", "tools"} <= named <= set(about.get_all("Provides-Extra"))
    assert not [text for text in texts if re.search(r"\breem\[[a-z]", text)]
