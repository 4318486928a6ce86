"""Parameters on the page: controls for what programs have declared, and no value that they do not allow."""

# ruff: noqa: F811 - fixtures are named as arguments
import html
import json
import re

import pytest
from browserkit import client_of, live, served
from conftest import eventually
from pagekit import chromium, expect, visit  # noqa: F401

import reem


@pytest.fixture
def control(server_url, key):
    """A program that has declared parameters, with each kind of control; one of them has a value out of range."""
    with reem.RedisInterface(server_url, namespace=f"{key.prefix}:") as interface:
        control = reem.KeyValueStore(interface)["control"]
        control.parameter("kp", 2.0, low=0.0, high=10.0, unit="1/s", help="<b>gain</b>")
        control.parameter("mode", "hold", choices=["hold", "track"])
        control.parameter("motor", False)
        control.parameter("big", 2**60 + 1)
        control.parameter("gains", [1.0, 0.5], low=0)
        control["limit"] = 99
        control.parameter("limit", 1, high=5)
        yield control


@pytest.fixture
def address(request, server_url, key):
    """A page of the test's namespace; it may write unless the test says otherwise."""
    with served(live(server_url, namespace=f"{key.prefix}:"), allow_write=getattr(request, "param", True)) as (own, _):
        yield own


def test_controls_show_what_programs_use_and_write_what_they_allow(visit, control):
    page = visit.open("/view/control")
    kp, slider = page.locator("[id='parameter-control.kp']"), page.get_by_role("slider", name="control.kp")
    expect(page.locator(".parameter")).to_have_count(6)
    expect(page.get_by_text("<b>gain</b> · 0.0 to 10.0 · default 2.0")).to_be_visible()
    expect(page.get_by_text("The stored value is ignored: control.limit: 99")).to_be_visible()
    control["kp"] = 3.5
    expect(kp).to_have_value("3.5")
    expect(slider).to_have_value("3.5")
    slider.press("ArrowRight")  # moves the slider, and not through time
    expect(kp).to_have_value("3.51")
    eventually(lambda: control["kp"].read() == 3.51)
    control["kp"] = 4.5
    expect(kp).to_have_value("4.5")
    expect(slider).to_be_focused()
    page.get_by_role("switch").press("Space")
    page.locator("[id='parameter-control.mode']").select_option("track")
    for name, typed in (("gains", "[2, 0.25]"), ("big", str(2**60 + 3))):
        page.locator(f"[id='parameter-control.{name}']").fill(typed)
        page.keyboard.press("Enter")
    expect(page.locator("#toast")).to_have_text("Written")
    wanted = {"kp": 4.5, "motor": True, "mode": "track", "gains": [2, 0.25], "big": 2**60 + 3, "limit": 99}
    eventually(lambda: control.read() == wanted)
    expect(page.locator("#live")).to_have_attribute("aria-pressed", "true")


def test_what_is_not_allowed_is_refused_beside_its_control(visit, control):
    page = visit.open("/view/control.gains")
    field = page.locator("[id='parameter-control.gains']")
    for typed, message in (
        ("[1, -1]", "out of range"),
        ("[1]", "use 2"),
        ("fast", "is not a value"),
        (" ", "Type a number"),
    ):
        field.fill(typed)
        page.keyboard.press("Enter")
        expect(page.locator(".parameter .wrong")).to_contain_text(message)
        expect(field).to_have_attribute("aria-invalid", "true")
        assert control["gains"].read() == [1.0, 0.5]
    field.fill("[3, 3]")
    page.keyboard.press("Enter")
    expect(page.locator(".parameter .wrong")).to_be_hidden()
    expect(page.locator("#toast")).to_have_text("Written")
    assert control["gains"].read() == [3.0, 3.0]
    visit.said[:] = [line for line in visit.said if "status of 400" not in line]


@pytest.mark.parametrize("scheme", ["light", "dark"])
@pytest.mark.parametrize("address", [False], indirect=True)
def test_a_page_that_is_read_only_shows_parameters_and_fits_a_phone(visit, control, scheme):
    page = visit.open("/view/control", color_scheme=scheme)
    page.set_viewport_size({"width": 390, "height": 800})
    expect(page.locator(".parameter")).to_have_count(6)
    for control_of_page in page.locator(".control input, .control select").all():
        expect(control_of_page).to_be_disabled()
    assert page.evaluate("document.documentElement.scrollWidth") <= 390
    assert page.evaluate("document.querySelector('#view').scrollWidth <= document.querySelector('#view').clientWidth")


def test_the_program_behind_the_page_checks_what_it_is_sent(address, control):
    with client_of(address) as client:
        config = re.search(r'data-config="([^"]*)"', client.http.get("/").text)[1]
        headers = {"origin": address, "x-reem-key": json.loads(html.unescape(config))["key"]}
        for name, value, status in [
            *[("kp", 10.5, 400), ("kp", "fast", 400), ("motor", 1, 400), ("big", 2**70, 400)],
            *[("limit", 4, 200), ("kp", 10, 200)],
        ]:
            body = {"path": f"control.{name}", "value": value}
            answer = client.http.post("/api/write", json=body, headers=headers)
            assert answer.status_code == status, answer.text
    wanted = {"kp": 10.0, "mode": "hold", "motor": False, "big": 2**60 + 1, "gains": [1.0, 0.5], "limit": 4}
    assert control.read() == wanted
