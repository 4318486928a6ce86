"""The page of one's own in examples/clients/browser shows a value, follows it, and opens no way in for other sites."""

import shutil
import subprocess

import httpx
import numpy as np
import pytest
from conftest import ROOT
from pagekit import Visitor, address, chromium, expect, visit  # noqa: F401

FOLDER = ROOT / "examples" / "clients" / "browser"


@pytest.fixture
def own_page(address):  # noqa: F811
    if shutil.which("node") is None:
        pytest.skip("needs node")
    command = ["node", str(FOLDER / "serve.mjs"), address, "0"]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as process:
        yield process.stdout.readline().strip().rstrip("/")
        process.kill()


@pytest.mark.long
def test_a_page_of_ones_own_shows_and_follows_a_value(visit, own_page, kvs, key):  # noqa: F811
    kvs[key()] = {"speed": 0.5, "q": np.array([0.0, 0.5, 1.0])}
    page = visit.open(f"/?path={key()}", address=own_page)
    value = page.locator("#value")
    expect(value).to_contain_text("speed: 0.5")
    kvs[key()]["speed"] = 1.5
    expect(value).to_contain_text("speed: 1.5")
    page.fill("#path", key("foo") + ".q")
    expect(value).to_contain_text("float64[3]\n0\n0.5\n1", use_inner_text=True)
    expect(page.locator("#plot")).to_be_visible()
    page.context.close()  # before its server ends, which it would report
    # As other sites would ask: by a name that leads here, from a page of theirs, or to write.
    for headers in ({"host": "evil.example"}, {"sec-fetch-site": "cross-site"}):
        assert httpx.get(f"{own_page}/api/node", params={"path": key()}, headers=headers).status_code in (403, 421)
    assert httpx.post(f"{own_page}/api/write", json={"path": key(), "value": 1}).status_code == 404
