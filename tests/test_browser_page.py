"""The page, in headless Chromium: clicking, searching, dragging the slider, and what is seen then."""

# ruff: noqa: F811 - fixtures are named as arguments
import re
import threading
import time

import numpy as np
import pytest
from browserkit import served
from conftest import PATIENCE, eventually
from pagekit import Visitor, address, chromium, playwright, row, visit  # noqa: F401
from recordkit import write_mixed

from reem_async.tools.browser import logsource

expect = playwright.expect


@pytest.mark.long
def test_the_tree_opens_closes_and_remembers(visit, kvs, key):
    name = key("robot")
    kvs[name] = {"arm": {"q": [1.5, 2.5], "on": True}, "image": np.zeros((20, 30), np.uint8)}
    page = visit.open()
    row(page, name).locator(".twist").click()
    expect(row(page, f"{name}.image")).to_contain_text("uint8[20,30]")
    expect(row(page, f"{name}.image")).to_contain_text("600 B")
    expect(row(page, name).locator(".size")).to_have_text("624 B")  # of all that is in it
    row(page, f"{name}.arm").locator(".twist").click()
    expect(row(page, f"{name}.arm.q")).to_contain_text("[1.5, 2.5]")
    page.reload()
    expect(row(page, f"{name}.arm.on")).to_contain_text("true")
    expect(row(page, f"{name}.arm")).to_have_attribute("aria-expanded", "true")
    row(page, name).locator(".twist").click()
    expect(row(page, f"{name}.arm")).to_have_count(0)


def test_values_are_live_and_addresses_lead_to_them(visit, pspace, key):
    name = key("battery")
    pspace[name] = {"volt": 12.5, "name": "main", "full": False}
    page = visit.open(f"/view/{name}.volt")
    expect(page.locator(".big")).to_have_text("12.5")
    for value in (11.75, 9.25):
        pspace[name]["volt"] = value
        expect(page.locator(".big")).to_have_text(str(value))
    page.reload()
    expect(page.locator(".big")).to_have_text("9.25")
    expect(page.locator("canvas.plot")).to_be_visible()
    page.locator(".crumb").click()
    expect(page).to_have_url(re.compile(f"/view/{name}$"))
    expect(row(page, f"{name}.name", "#view")).to_contain_text('"main"')
    row(page, f"{name}.full", "#view").click()
    expect(page.locator(".big")).to_have_text("false")
    page.go_back()
    page.go_back()
    expect(page.locator(".big")).to_have_text("9.25")


def test_search(visit, kvs, key):
    kvs[key("alpha")] = {"needle_x": 1}
    kvs[key("beta")] = {"other": 2}
    page = visit.open()
    expect(row(page, key("beta"))).to_be_visible()
    page.keyboard.press("/")
    expect(page.locator("#search")).to_be_focused()
    page.keyboard.type("NEEDLE_")
    expect(row(page, f"{key('alpha')}.needle_x")).to_contain_text("1")
    expect(page.locator("#tree .row")).to_have_count(1)
    page.keyboard.press("Enter")
    expect(page.locator(".head h1")).to_have_text(f"{key('alpha')}.needle_x")
    page.locator("#search").fill("no such key anywhere")
    expect(page.locator("#tree")).to_contain_text("No key has")
    page.locator("#search").press("Escape")
    expect(row(page, key("beta"))).to_be_visible()


SLOW = """([what, pause]) => {
  const real = window.fetch;
  window.fetch = async (...all) => {
    const answer = await real(...all);
    if (String(all[0]).includes(what)) await new Promise((done) => setTimeout(done, pause));
    return answer;
  };
}"""


@pytest.mark.long
def test_what_a_search_finds_has_its_whole_path_though_the_tree_comes_late(visit, pspace, key):
    """Rows of a tree that was on its way were taken for what was found: `image`, `image`, of which robot?"""
    name = key("robot")
    pspace[name] = {"needle": 1}
    page = visit.open(f"/view/{name}")
    row(page, name).locator(".twist").click()
    expect(row(page, f"{name}.needle").locator(".key")).to_have_text("needle")
    page.evaluate(SLOW, ["/api/tree", 1500])
    pspace[name]["needle"] = 2
    time.sleep(0.3)
    page.locator("#search").fill("NEEDLE")
    expect(row(page, f"{name}.needle").locator(".key")).to_have_text(f"{name}.needle")
    page.locator("#search").press("Escape")
    expect(row(page, f"{name}.needle").locator(".key")).to_have_text("needle")


BROKEN = """([what, times]) => {
  const real = window.fetch;
  window.fetch = async (...all) => {
    const answer = await real(...all);
    if (!String(all[0]).includes(what) || times-- <= 0) return answer;
    const body = new ReadableStream({ start: (to) => to.error(new TypeError("network error")) });
    return new Response(body, { status: 200, headers: answer.headers });
  };
}"""


@pytest.mark.long
@pytest.mark.parametrize("what", ["/api/tree", "/api/node", "/api/image"])
def test_after_an_answer_that_breaks_off_the_page_goes_on(visit, pspace, key, what):
    """It took itself for busy from then on, and showed nothing new for ever."""
    name = key("arm")
    pspace[name] = {"x": 1, "image": np.zeros((20, 30), np.uint8)}
    page = visit.open(f"/view/{name}.{'image' if what == '/api/image' else 'x'}")
    expect(row(page, f"{name}.x")).to_contain_text("1")
    page.evaluate(BROKEN, [what, 1])
    pspace[name]["image"] = np.ones((20, 30), np.uint8)
    pspace[name]["x"] = 2
    expect(row(page, f"{name}.x")).to_contain_text("2")
    pspace[name]["x"] = 3
    expect(row(page, f"{name}.x")).to_contain_text("3")
    expect(page.locator("#banner")).to_be_hidden()


@pytest.mark.long
def test_a_picture_that_is_on_its_way_is_not_drawn_as_a_broken_one(visit, kvs, key):
    kvs[key()] = np.zeros((20, 30), np.uint8)
    page = visit.open()
    page.evaluate(SLOW, ["/api/image", 3000])
    row(page, key()).click()
    expect(page.locator(".picture img")).to_have_css("visibility", "hidden")
    expect(page.locator(".picture img")).to_have_css("visibility", "visible")


def test_dragging_the_slider_shows_the_past(visit, pspace, key):
    name = key("arm")
    pspace[name] = {"mode": "idle", "x": 0.0}
    page = visit.open(f"/view/{name}.mode")
    expect(page.locator("pre.text")).to_have_text("idle")
    until = time.monotonic() + 1.2
    while time.monotonic() < until:  # time must pass, or there is no past to go to
        pspace[name]["x"] = time.monotonic()
        page.wait_for_timeout(50)
    pspace[name]["mode"] = "run"
    expect(page.locator("pre.text")).to_have_text("run")
    at = when(page, name)
    box = page.locator("#slider").bounding_box()
    span = page.evaluate("Number(document.getElementById('slider').max)")
    assert span > 1
    page.mouse.move(box["x"] + box["width"] - 8, box["y"] + box["height"] / 2)
    page.mouse.down()
    part = 1 - (page.evaluate("Date.now() / 1000") - at + 0.5) / span
    page.mouse.move(box["x"] + 8 + (box["width"] - 16) * part, box["y"] + box["height"] / 2, steps=5)
    page.mouse.up()
    expect(page.locator("pre.text")).to_have_text("idle")
    expect(row(page, f"{name}.mode")).to_contain_text('"idle"')
    expect(page.locator("#live")).to_have_attribute("aria-pressed", "false")
    expect(page).to_have_url(re.compile(r"\?at=\d+"))
    page.locator("#live").click()
    expect(page.locator("#live")).to_have_attribute("aria-pressed", "true")
    pspace[name]["mode"] = "done"
    expect(page.locator("pre.text")).to_have_text("done")


def when(page, name):
    return page.evaluate("async (path) => (await (await fetch('/api/node?path=' + path)).json()).time", f"{name}.mode")


@pytest.mark.long
def test_the_page_of_a_recording_is_at_work_while_the_file_is_opened_and_read(visit, tmp_path, monkeypatch):
    go_on, opening = threading.Event(), logsource.open_log

    def slow(files, ships, progress):
        progress(1, 2)
        assert go_on.wait(PATIENCE)
        return opening(files, ships, progress=progress)

    monkeypatch.setattr(logsource, "open_log", slow)
    monkeypatch.setattr(logsource, "_AT_ONCE", 0)
    file = write_mixed(tmp_path / "run.mcap", 400)
    with served(lambda: logsource.LogSource(file)) as (address, _):
        page = visit.open("/view/arm.n", address)
        expect(page.locator("#reading")).to_have_attribute("max", "1")
        expect(page.locator("#reading")).to_be_visible()
        expect(page.locator("#reading")).to_have_js_property("value", 0.5)
        page.locator("#slider").click()
        expect(page.locator("#clock")).to_have_text("no recording")
        go_on.set()
        expect(page.locator(".big")).to_have_text("399")
        expect(row(page, "arm.n")).to_contain_text("399")
        expect(page.locator("#reading")).to_be_hidden()
        expect(page.locator("canvas.plot").first).to_be_visible()
        box = page.locator("#slider").bounding_box()
        page.mouse.click(box["x"] + box["width"] / 2, box["y"] + box["height"] / 2)
        expect(page.locator(".big")).to_have_text(re.compile(r"^(199|200|201)$"))
        expect(page.locator("#clock")).to_contain_text("of 99.75 s")
        for context in visit.contexts:
            context.close()


@pytest.mark.long
def test_stepping_and_playing_with_the_keyboard(visit, pspace, key):
    name = key("n")
    pspace[name] = 0
    page = visit.open(f"/view/{name}")
    expect(page.locator(".big")).to_have_text("0")
    for number in (1, 2, 3):
        page.wait_for_timeout(150)
        pspace[name] = number
        expect(page.locator(".big")).to_have_text(str(number))
    while page.locator(".big").text_content() == "3":
        page.keyboard.press("ArrowLeft")
        page.wait_for_timeout(300)
    expect(page.locator(".time")).to_have_class(re.compile("past"))
    expect(page.locator(".big")).to_have_text("2")
    expect(row(page, name)).to_have_class(re.compile("changed"))
    page.keyboard.press("Space")
    expect(page.locator("#play")).to_have_attribute("aria-label", "Pause")
    expect(page.locator(".big")).to_have_text("3")
    page.keyboard.press("Space")
    expect(page.locator("#play")).to_have_attribute("aria-label", "Play")
    page.keyboard.press("l")
    expect(page.locator("#live")).to_have_attribute("aria-pressed", "true")
    page.keyboard.press("?")
    expect(page.locator("#help")).to_be_visible()
    page.keyboard.press("Escape")
    expect(page.locator("#help")).to_be_hidden()


@pytest.mark.long
def test_arrays_have_tabs(visit, kvs, key):
    name = key("cam")
    image = np.zeros((60, 80, 3), np.uint8)
    image[:, :, 0] = 255
    kvs[name] = {"rgb": image, "deep": np.arange(2 * 30 * 40.0).reshape(2, 30, 40), "long": np.sin(np.arange(5e5))}
    page = visit.open(f"/view/{name}.rgb")
    expect(page.locator("#tab-image")).to_have_attribute("aria-selected", "true")
    eventually(lambda: colour(page) == [255, 0, 0])
    page.locator("input[type=checkbox]").check()
    eventually(lambda: colour(page) == [0, 0, 255])
    page.locator("#tab-table").click()
    expect(page.locator("tbody td").first).to_have_text("255")
    expect(page.locator(".pager.tools")).to_contain_text("rows 0–49 of 60")
    page.get_by_label("Rows after").click()
    expect(page.locator("tbody th").first).to_have_text("50")
    page.goto(f"{visit.address}/view/{name}.deep")
    box = page.get_by_label("Axis 0 of 2 items")
    expect(page.locator(".scale")).to_contain_text("1199")
    box.press("ArrowUp")
    expect(page.locator(".scale")).to_contain_text("2399")
    box.fill("9")
    box.press("Enter")
    expect(page.locator("#toast")).to_contain_text("neither")
    page.goto(f"{visit.address}/view/{name}.long")
    expect(page.locator("#tab-line")).to_have_attribute("aria-selected", "true")
    expect(page.locator("canvas.plot")).to_be_visible()
    page.locator("#tab-histogram").click()
    expect(page.locator("#tab-histogram")).to_have_attribute("aria-selected", "true")
    page.locator("#tab-table").click()
    page.get_by_label("Go to row").fill("499999")
    page.get_by_label("Go to row").press("Enter")
    expect(page.locator("tbody th").last).to_have_text("499999")


def colour(page):
    return page.evaluate(
        """() => {
            const image = document.querySelector(".picture img");
            if (!image || !image.complete || !image.naturalWidth) return null;
            const canvas = document.createElement("canvas");
            [canvas.width, canvas.height] = [image.naturalWidth, image.naturalHeight];
            const context = canvas.getContext("2d");
            context.drawImage(image, 0, 0);
            return [...context.getImageData(canvas.width / 2, canvas.height / 2, 1, 1).data].slice(0, 3);
        }"""
    )


def test_scripts_in_keys_and_values_are_only_text(visit, kvs, key):
    evil = '<img src=x onerror="window.broken=1"><script>window.broken=1</script>'
    name = key("x<b>\u202e")
    kvs[name] = {evil.replace('"', ""): evil, "list": [evil, {"<i>": evil}]}
    page = visit.open()
    shown = page.locator("#tree .row", has_text=key("x<b>\\u202e"))
    shown.locator(".twist").click()
    expect(page.locator("#tree")).to_contain_text("<script>window.broken=1")
    shown.click()
    expect(page.locator("#view")).to_contain_text("onerror=")
    page.locator("#view .row").first.click()
    expect(page.locator("pre.text")).to_have_text(evil)
    assert page.evaluate("window.broken") is None
    assert page.locator("img[onerror], #view b, #tree b, #tree script").count() == 0


def test_writing_asks_first_and_tells_subscribers(visit, pspace, kvs, key):
    name = key("gain")
    pspace[name] = {"kp": 2.0}
    page = visit.open(f"/view/{name}.kp")
    expect(page.locator("#badge")).to_have_text("can write")
    page.get_by_text("Edit", exact=True).click()
    area = page.get_by_label("New value, as JSON")
    expect(area).to_have_value("2.0")
    area.fill("3.5")
    page.get_by_text("Write…").click()
    expect(page.locator("#confirm-old")).to_have_text("2.0")
    page.get_by_role("button", name="Cancel").click()
    assert kvs[name]["kp"].read() == 2.0
    page.get_by_text("Write…").click()
    page.get_by_role("button", name="Write", exact=True).click()
    expect(page.locator(".big")).to_have_text("3.5")
    assert kvs[name]["kp"].read() == 3.5
    area.fill("three")
    page.get_by_text("Write…").click()
    expect(page.locator(".wrong")).to_contain_text("Not JSON")
    expect(area).to_have_attribute("aria-invalid", "true")
    expect(page.locator("#confirm")).to_be_hidden()
    area.fill("3")
    expect(page.locator(".wrong")).to_be_hidden()
    page.get_by_text("Write…").click()
    page.get_by_role("button", name="Write", exact=True).click()
    expect(page.locator(".big")).to_have_text("3.0")  # where a float was, there is one
    area.fill('"three"')
    for answer in ("Cancel", "Change the type"):
        page.get_by_text("Write…").click()
        page.get_by_role("button", name="Write", exact=True).click()
        expect(page.locator("#confirm-hint")).to_contain_text(f"{name}.kp: float becomes str")
        value = kvs[name]["kp"].read()
        assert (value, type(value)) == (3.0, float)
        page.get_by_role("button", name=answer).click()
    eventually(lambda: kvs[name]["kp"].read() == "three")


@pytest.mark.long
def test_what_is_gone_is_said_and_comes_back(visit, pspace, kvs, key):
    name = key("here")
    page = visit.open(f"/view/{name}")
    expect(page.locator(".note")).to_contain_text("nothing is stored")
    pspace[name] = "now"
    expect(page.locator("pre.text")).to_have_text("now")
    del pspace[name]
    expect(page.locator(".note")).to_contain_text("nothing is stored")


@pytest.mark.long
def test_what_is_typed_is_not_lost_when_the_type_changes(visit, pspace, key):
    pspace[key("mode")] = 1
    page = visit.open(f"/view/{key('mode')}")
    page.get_by_text("Edit", exact=True).click()
    area = page.get_by_label("New value, as JSON")
    expect(area).to_have_value("1")
    area.fill("[7, 8")
    for value in (1.5, "text", None):
        pspace[key("mode")] = value
        time.sleep(0.7)
    expect(page.locator(".note")).to_contain_text("null now")
    assert area.input_value() == "[7, 8"
    page.get_by_text("Edit", exact=True).click()
    expect(page.locator(".big")).to_have_text("null")
    expect(page.locator(".note")).to_be_hidden()


def test_the_keyboards_place_in_the_tree_is_kept_when_rows_above_vanish(visit, pspace, kvs, key):
    pspace[key("a_first")] = 1
    kvs[key("b_second")] = 2
    page = visit.open("/")
    row(page, key("b_second")).focus()
    del pspace[key("a_first")]
    expect(row(page, key("a_first"))).to_have_count(0)
    expect(row(page, key("b_second"))).to_be_focused()


@pytest.mark.long
def test_numbers_have_a_line_in_the_tree(visit, pspace, key):
    page = visit.open("/")
    for number in (1.0, 3.0, -2.0):
        pspace[key()] = number
        expect(row(page, key()).locator(".value")).to_have_text(str(number))
    drawn = "it => it.getContext('2d').getImageData(0, 0, it.width, it.height).data.some(each => each)"
    assert row(page, key()).locator("canvas.spark").evaluate(drawn)
    pspace[key()] = "text"
    expect(row(page, key()).locator("canvas.spark")).to_be_hidden()


TICKS = [
    (-4e17, 1e17, "-4e+17"),
    (5_000_020, 20, "5000020"),
    (1.795424e9, 10, "1795424000"),
    (-123456.7, 0.1, "-123456.7"),
    (-122.4194, 0.0001, "-122.4194"),
    (1.23e-9, 1e-11, "1.23e-9"),
    (1e-20, 0.1, "0"),
    (-9.1e18, 1e16, "-9.10e+18"),
]


def test_ticks_tell_themselves_from_each_other(visit):
    page = visit.open("/")
    for value, step, text in TICKS:
        assert page.evaluate(f"import('/static/plot.js').then(it => it.tickText({value!r}, {step!r}))") == text


def test_the_labels_of_an_axis_have_room(visit, kvs, key):
    kvs[key()] = np.linspace(-123456.7, -123456.1, 50)
    page = visit.open(f"/view/{key()}")
    page.get_by_role("tab", name="Lines").click()
    expect(page.locator("canvas.plot")).to_be_visible()
    # Nothing is drawn at the left edge: what would be cut off begins there.
    clear = "it => it.getContext('2d').getImageData(0, 0, 2, it.height).data.every(each => !each)"
    eventually(lambda: page.locator("canvas.plot").evaluate("it => it.width > 300"))
    assert page.locator("canvas.plot").evaluate(clear)


def test_a_stray_percent_in_the_address_is_said(visit):
    page = visit.open("/view/100%25%")
    expect(page.locator(".note")).to_contain_text("nothing is stored")
    expect(page.locator("#dot")).to_have_class("dot ok")


def test_the_scale_of_colours_is_there_again_after_other_tabs(visit, kvs, key):
    kvs[key()] = np.linspace(0, 1, 400).reshape(20, 20)
    page = visit.open(f"/view/{key()}")
    drawn = """it => {
        const blank = Object.assign(document.createElement("canvas"), { width: it.width, height: it.height });
        return it.toDataURL() !== blank.toDataURL();
    }"""
    for tab in ("Image", "Lines", "Image"):
        page.get_by_role("tab", name=tab).click()
    eventually(lambda: page.locator(".scale canvas").evaluate(drawn))


@pytest.mark.long
def test_on_a_phone_the_tree_and_the_value_take_turns(visit, kvs, pspace, key):
    kvs[key("a_rather_long_name_of_a_key")] = {"x": list(range(40)), "text": "word " * 200}
    name = key("a_rather_long_name_of_a_key")
    page = visit.open("/")
    page.set_viewport_size({"width": 360, "height": 640})
    pspace[key("busy")] = 1.0
    card = page.locator(f'.pane .pane-head a[title="{key("busy")}"]')
    for number in range(100):
        pspace[key("busy")] = float(number % 3)
        page.wait_for_timeout(30)
        if card.count():
            break
    expect(card).to_be_in_viewport()
    assert card.bounding_box()["y"] < row(page, name).bounding_box()["y"]
    page.get_by_role("button", name="Keys", exact=True).click()
    expect(row(page, name)).to_be_in_viewport()
    row(page, name).click()
    expect(page.locator("nav")).to_be_hidden()
    row(page, f"{name}.text", "#view").click()
    expect(page.locator("pre.text")).to_be_visible()
    for _ in range(2):
        assert page.evaluate("document.documentElement.scrollWidth") <= 360
        assert page.evaluate(
            "document.querySelector('#view').scrollWidth <= document.querySelector('#view').clientWidth"
        )
        page.get_by_text("all keys").click()
        expect(row(page, name)).to_be_visible()
        page.go_back()
    expect(page.locator("#live")).to_be_in_viewport()


HIDE = """hidden => {
  Object.defineProperty(document, "hidden", { configurable: true, get: () => hidden });
  document.dispatchEvent(new Event("visibilitychange"));
}"""


@pytest.mark.long
def test_pages_in_other_tabs_take_no_connection_and_come_back_up_to_date(visit, pspace, key):
    """A browser has six for all pages of one host: a seventh page would wait for ever."""
    pspace[key()] = 1
    pages = [visit.open(f"/view/{key()}")]
    for _ in range(7):
        pages[-1].evaluate(HIDE, True)
        page = pages[0].context.new_page()
        page.goto(pages[0].url)
        expect(page.locator(".big")).to_have_text("1")
        pages.append(page)
    pspace[key()] = 2
    expect(pages[-1].locator(".big")).to_have_text("2")
    expect(pages[0].locator(".big")).to_have_text("1")
    pages[0].evaluate(HIDE, False)
    expect(pages[0].locator(".big")).to_have_text("2")
    pspace[key()] = 3
    expect(pages[0].locator(".big")).to_have_text("3")
    expect(pages[0].locator("#banner")).to_be_hidden()


def test_ten_thousand_rows_do_not_make_the_page_slow(visit, kvs, key):
    kvs[key()] = {f"k{number:05}": number for number in range(10_000)}
    page = visit.open(f"/view/{key()}")
    expect(page.locator("#view .row")).to_have_count(100)
    expect(page.locator("#view .more")).to_contain_text("1–100 of 10,000")
    page.locator("#view .more").get_by_text("100 ›").click()
    expect(page.locator("#view .row").first).to_contain_text("k00100")
