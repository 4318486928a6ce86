"""Who may ask the browser, and for what: other sites, other names, scripts in keys, writes."""

# ruff: noqa: F811 - fixtures are named as arguments
import html
import re
import socket
import urllib.parse

import numpy as np
import orjson
import pytest
from browserkit import address, ask, client_of, live, served  # noqa: F401 - fixtures
from conftest import eventually

from reem_async.tools.browser.app import LOOPBACK


@pytest.fixture
def robot(kvs, key):
    name = key("robot")
    kvs[name] = {"n": 1, "big": 0, "nested": [{"a": 1}, {"a": 2}], "image": np.zeros((4, 4))}
    return name


def test_the_page_is_guarded_by_its_headers(ask):
    for path in ("/", "/view/a.b", "/static/main.js", "/api/tree", "/nothing"):
        headers = ask.http.get(path).headers
        policy = headers["content-security-policy"]
        assert "default-src 'none'" in policy
        assert "script-src 'self';" in policy
        assert "unsafe" not in policy
        assert "frame-ancestors 'none'" in policy
        assert (headers["x-content-type-options"], headers["x-frame-options"]) == ("nosniff", "DENY")


def test_nothing_but_the_known_files_is_served(ask):
    assert ask.http.get("/static/main.js").headers["content-type"].startswith("text/javascript")
    for path in (
        "/static/../app.py",
        "/static/..%2fapp.py",
        "/static/%2e%2e/app.py",
        "/static/page.html",
        "/static/",
        "/static/__init__.py",
        "/view/../../etc/passwd",
        "/view/..%2f..%2fetc%2fpasswd",
        "/view/a..b",
        "/view/%2e%2e",
        "/etc/passwd",
    ):
        answer = raw_get(ask, path)
        assert answer.startswith(("HTTP/1.1 404", "HTTP/1.1 307")), (path, answer[:200])
        assert "root:" not in answer
        assert "create_app" not in answer


def raw_get(ask, path):
    """What is answered to a path sent as it is: clients clean it up."""
    with socket.create_connection((ask.http.base_url.host, ask.http.base_url.port), 10) as sock:
        sock.sendall(f"GET {path} HTTP/1.1\r\nHost: localhost\r\nConnection: close\r\n\r\n".encode())
        pieces = []
        while piece := sock.recv(65536):
            pieces.append(piece)
    return b"".join(pieces).decode(errors="replace")


@pytest.mark.parametrize(
    "host", ["evil.example", "127.0.0.1.evil.example", "", "192.168.1.5", "localhost.evil.example:80"]
)
def test_another_name_for_this_address_is_refused(ask, host):
    assert ask.http.get("/", headers={"host": host}).status_code in (400, 421)
    assert ask.http.get("/api/tree", headers={"host": host}).status_code in (400, 421)


def test_this_machines_own_names_are_accepted(ask):
    for host in ("localhost", "LOCALHOST:8080", "127.0.0.1:1", "[::1]:8080", "localhost."):
        assert ask.http.get("/", headers={"host": host}).status_code == 200


def test_requests_of_other_sites_are_refused(ask):
    headers = {"sec-fetch-site": "cross-site", "sec-fetch-mode": "no-cors"}
    assert ask.http.get("/api/tree", headers=headers).status_code == 403
    assert ask.http.get("/", headers={**headers, "sec-fetch-mode": "navigate"}).status_code == 200


def test_a_link_on_another_site_leads_to_the_first_page_only(ask, kvs, key):
    kvs[key()] = {"a": 1}
    headers = {"sec-fetch-site": "cross-site", "sec-fetch-mode": "navigate", "sec-fetch-dest": "document"}
    for path in ("/api/tree", "/api/node?path={}", "/view/{}", "/api/array?path={}"):
        assert ask.http.get(path.format(key()), headers=headers).status_code == 403


@pytest.mark.parametrize("element", ['[" x"]', '["a\\\\b"]', "[9223372036854775808]"])
def test_what_the_servers_paths_cannot_address_is_a_bad_request(ask, kvs, key, element):
    kvs[key()] = {"x": 1, " x": 2}
    for path in (f'["{key()}"]{element}', f"{key()}{element}"):
        answer = ask.ask("array", path=path)
        assert answer.status_code == 400
        assert "position" not in answer.text


def test_keys_and_values_with_scripts_do_not_become_html(ask, kvs, key):
    evil = "</script><img src=x onerror=alert(1)>\u202e"
    kvs[key(evil)] = {evil: evil}
    row = eventually(lambda: ask.rows().get(key(evil).replace("\u202e", "\\u202e")))
    inside = ask.json("tree", open=f"10:0:{row['address']}")["branches"][0]["nodes"][0]
    assert "\u202e" not in inside["label"] + inside["text"]
    answer = ask.http.get("/view/" + urllib.parse.quote(row["address"], safe=""))
    assert answer.status_code == 200
    assert "onerror" not in answer.text
    assert ask.json("node", path=inside["address"])["full"] == evil.replace("\u202e", "\\u202e")


def test_it_can_only_look_unless_told_otherwise(ask, address, robot, kvs):
    body = {"path": f"{robot}.n", "value": 2}
    answer = ask.http.post("/api/write", json=body, headers={"origin": address})
    assert answer.status_code == 403
    assert "--allow-write" in answer.json()["error"]
    for method in ("PUT", "DELETE", "PATCH"):
        assert ask.http.request(method, "/api/write").status_code == 405
    assert ask.http.post("/api/tree").status_code == 405
    assert kvs[robot]["n"].read() == 1


@pytest.fixture(scope="module")
def writable(server_url):
    with served(live(server_url), allow_write=True) as (address, _):
        yield address


def config_of(text):
    return orjson.loads(html.unescape(re.search(r'data-config="([^"]*)"', text)[1]))


@pytest.fixture
def write(writable):
    with client_of(writable) as client:
        secret = config_of(client.http.get("/").text)["key"]

        def write(path, value, content=None, retype=False, **headers):
            given = {"origin": writable, "x-reem-key": secret, "content-type": "application/json"}
            given |= {name.replace("_", "-"): text for name, text in headers.items()}
            said = {"path": path, "value": value, "retype": retype}
            content = orjson.dumps(said) if content is None else content
            return client.http.post("/api/write", content=content, headers=given)

        yield write


def test_what_a_page_writes_is_published(write, robot, kvs, interface):
    updates = kvs[robot]["n"].watch()
    assert next(updates).value is not None
    assert write(f"{robot}.n", 7).status_code == 200
    update = next(updates)
    assert (update.path, update.data) == ((robot, "n"), 7) or update.data == 7
    updates.close()
    before = kvs[robot]["nested"].read()
    asked = write(f"{robot}.nested[1]", {"a": [1, None, "x"]})
    assert asked.json() == {"retyped": [f"{robot}.nested[1].a: int becomes list"]}
    assert kvs[robot]["nested"].read() == before, "a write that changes a type was not confirmed"
    assert write(f"{robot}.nested[1]", {"a": [1, None, "x"]}, retype=True).status_code == 200
    assert kvs[robot]["nested"].read() == [{"a": 1}, {"a": [1, None, "x"]}]
    assert write(f"{robot}.nested[0].a", 0.5, retype=True).status_code == 200
    huge = b'{"path":"%s.nested[0].a","value":1%s}' % (robot.encode(), b"0" * 400)  # larger than any float
    assert write("", None, content=huge).json() == {"retyped": [f"{robot}.nested[0].a: float becomes int"]}
    big = write("", None, content=b'{"path":"%s.big","value":9223372036854775807}' % robot.encode())
    assert big.status_code == 200
    assert kvs[robot]["big"].read() == 2**63 - 1


@pytest.mark.parametrize(
    ("headers", "status"),
    [
        ({"origin": "http://evil.example"}, 403),
        ({"origin": "null"}, 403),
        ({"origin": ""}, 403),
        ({"x_reem_key": "wrong"}, 403),
        ({"x_reem_key": ""}, 403),
        ({"sec_fetch_site": "cross-site"}, 403),
        ({"sec_fetch_site": "same-site"}, 403),
        ({"host": "evil.example"}, 421),
        ({"content_type": "text/plain"}, 415),
        ({"content_type": "application/x-www-form-urlencoded"}, 415),
    ],
)
def test_a_write_that_a_page_of_ours_would_not_send_is_refused(write, robot, kvs, headers, status):
    assert write(f"{robot}.n", 666, **headers).status_code == status
    assert kvs[robot]["n"].read() == 1


def test_writes_that_make_no_sense_are_refused(write, robot, kvs):
    for path, value, status in (
        ("", 1, 400),
        (f"{robot}.image", 1, 400),
        (robot, {}, 400),
        (f"{robot}.missing", 1, 404),
        (f"{robot}..n", 1, 400),
        (f"{robot}.n.x", 1, 404),
    ):
        answer = write(path, value)
        assert answer.status_code == status, (path, answer.text)
    for content, status in (
        (b"{", 400),
        (b"[]", 400),
        (b'{"path":1,"value":2}', 400),
        (b" " * 70_000, 413),
        (b"NaN", 400),
        (b'{"path":"%b.n","value":NaN}' % robot.encode(), 400),
        (b'{"path":"%b.n","value":18446744073709551616}' % robot.encode(), 400),
        (b'{"path":"%b.n","value":%b}' % (robot.encode(), b"[" * 30_000), 400),
    ):
        assert write("", None, content=content).status_code == status, content[:20]
    assert kvs[robot]["n"].read() == 1


def test_a_token_is_asked_for_once_and_kept_in_a_cookie(server_url):
    guarded = served(live(server_url), token="s3cret-token", hosts=LOOPBACK, any_address=True)
    with guarded as (address, _), client_of(address) as ask:
        for path in ("/", "/view/x", "/static/main.js", "/api/tree", "/api/events"):
            assert ask.http.get(path).status_code == 403
            assert ask.http.get(path, params={"token": "wrong"}).status_code == 403
            assert ask.http.get(path, params={"token": ""}).status_code == 403
            wrong = f"reem_browse_{ask.http.base_url.port}=s3cret-tokem"
            assert ask.http.get(path, headers={"cookie": wrong}).status_code == 403
        answer = ask.http.get("/view/a.b", params={"token": "s3cret-token", "at": "5"})
        assert (answer.status_code, answer.headers["location"]) == (303, "/view/a.b?at=5")
        cookie = answer.headers["set-cookie"].lower()
        assert "httponly" in cookie
        assert "samesite=strict" in cookie
        assert ask.http.get("/").status_code == 200
        other = {"host": "10.0.0.7:80", "cookie": "reem_browse_80=s3cret-token"}
        assert ask.http.get("/", headers=other).status_code == 200
        assert ask.http.get("/", headers={"host": "robot.example"}).status_code == 421
        answer = raw_get(ask, "//evil.example/?token=s3cret-token")
        assert "location: /evil.example/\r\n" in answer, "two slashes would lead to another server"


def test_two_programs_on_one_machine_keep_their_cookies_apart(server_url):
    """Browsers send the cookies of a host to all its ports, and keep one of each name."""
    one, two = (served(live(server_url), token=token) for token in ("first-token", "second-token"))
    with one as (first, _), two as (second, _), client_of(first) as ask:
        assert ask.http.get(f"{first}/?token=first-token").status_code == 303
        assert ask.http.get(f"{second}/?token=second-token").status_code == 303
        assert [ask.http.get(f"{address}/").status_code for address in (first, second)] == [200, 200]


def test_long_requests_are_refused(ask):
    assert raw_get(ask, "/api/tree?open=1:0:" + "x" * 100_000).startswith("HTTP/1.1 414")
