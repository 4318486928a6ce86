"""The page as something one leaves open all day: what it marks, says and plots."""

# ruff: noqa: F811 - fixtures are named as arguments
import contextlib
import itertools
import json
import re
import time
import tracemalloc
from urllib.parse import quote

import numpy as np
import pytest
from browserkit import client_of, live, served
from conftest import eventually, repeated
from pagekit import Visitor, address, chromium, playwright, row, visit  # noqa: F401

from reem import PublishSpace, RedisInterface
from reem.server import EmbeddedServer
from reem_async.errors import BadInput, BadValue, RemoteError
from reem_async.plan.keys import keys_of
from reem_async.tools.browser.history import History
from reem_async.tools.browser.logsource import LogSource
from reem_async.tools.browser.overlays import hints_of, shapes_of
from reem_async.tools.browser.trees import differing

expect = playwright.expect


# --- one instant, and what changed at it -------------------------------


def test_the_figures_beside_an_array_are_of_that_array(pspace, address, key):
    """They were asked for separately, and were of another frame than the table."""
    pspace[key()] = {"a": np.zeros((40, 40))}
    with (
        repeated(lambda number: pspace[key()]["a"].write(np.full((40, 40), number, np.float64))),
        client_of(address) as ask,
    ):
        for _ in range(20):
            for view in ("table", "line", "histogram"):
                said = ask.json(view, path=f"{key()}.a")
                low, high = said["statistics"]["low"], said["statistics"]["high"]
                found = {"table": "cells", "line": "lines", "histogram": "low"}[view]
                shown = said[found] if view == "histogram" else said[found][0][0]
                assert float(low) == float(high) == float(shown), view


def test_only_what_has_another_value_is_marked_as_changed(pspace, address, key):
    value = {"mode": "idle", "n": 1, "q": [1.0, 2.0], "deep": {"a": 1, "b": 2}, "x": 5}
    pspace[key()] = value
    with client_of(address) as ask:
        eventually(lambda: key() in ask.rows())
        time.sleep(0.05)
        before = ask.json("tree", open="1:0:")["end"]
        newer = value | {"n": 2, "q": [1.0, 3.0], "deep": {"a": 1, "b": 3}, "new": 1}
        del newer["x"]
        pspace[key()] = newer
        eventually(lambda: "new" in ask.rows(key()))
        after = ask.json("tree", open="1:0:")["end"]
        marks = {label: it["mark"] for label, it in ask.rows(key(), at=after, since=before).items()}
        assert marks == {"mode": "", "n": "changed", "q": "changed", "deep": "inside", "new": "changed"}
        assert {label: it["mark"] for label, it in ask.rows(f"{key()}.q", at=after, since=before).items()} == {
            "[0]": "",
            "[1]": "changed",
        }
        assert ask.rows(at=after, since=before)[key()]["mark"] == "inside"


def test_arrays_that_were_published_again_with_the_same_items_are_not_marked():
    one, same, other = np.zeros(5), np.zeros(5), np.ones(5)
    for new, found in ((same, set()), (other, {("k", "a")}), (other.astype(int), {("k", "a")})):
        assert (
            differing([("k",)], lambda name: {"a": one, "n": 1}, lambda name, new=new: {"a": new, "n": 1}, 9) == found
        )
    assert len(differing([("k",)], lambda name: {}, lambda name: dict.fromkeys("abcdefgh", 1), 5)) == 5


def test_the_rate_at_the_beginning_of_what_is_known_is_right():
    """It was that of a second of which only a part was known."""
    history = History(1000.0, 1 << 20)
    history.start = 100.0
    for number in range(1, 100):
        history.add(("k", "x"), number, 8, 100 + number / 20)
    for at in (100.1, 100.3, 100.9, 101.5, 104.0):
        assert history.rate("k", at) == pytest.approx(20.0, rel=0.06), at
    assert (history.rate("k", 140.0), history.rate("other", 104.0)) == (None, None)
    history = History(1000.0, 1 << 20)
    history.add(("k", "x"), 1, 8, time.time())
    assert history.rate("k", time.time()) is None, "less than a second is known: that is no rate"


# --- what the page says -------------------------------


@pytest.mark.long
def test_a_server_that_died_greys_the_page_and_is_told_in_plain_words(chromium, tmp_path):
    visitor = Visitor(chromium, None)
    with EmbeddedServer(directory=tmp_path / "data") as server, served(live(server.url)) as (address, _):
        page = visitor.open("/", address)
        expect(page.locator("#tree")).to_contain_text("reem set demo 1")
        live_colour = "getComputedStyle(document.getElementById('live')).backgroundColor"
        green = page.evaluate(live_colour)
        port = server.port
        server.stop()
        expect(page.locator("#banner")).to_contain_text(
            re.compile("^The server at 127.0.0.1:.* has not answered since")
        )
        expect(page.locator("#banner")).not_to_contain_text("Error")
        expect(page.locator("#banner")).to_have_attribute("title", re.compile("no server answers"))
        assert page.evaluate(live_colour) != green
        assert "grayscale" in page.evaluate("getComputedStyle(document.querySelector('main')).filter")
        with EmbeddedServer(port, tmp_path / "data") as again:
            expect(page.locator("#banner")).to_be_hidden()
            assert page.evaluate(live_colour) == green
            with RedisInterface(again.url) as interface, client_of(address) as ask:
                space = PublishSpace(interface)
                space["n"] = 1
                eventually(lambda: "n" in ask.rows())
                (gap,) = ask.json("series", path="n", start=0)["losses"]
                assert gap[0] < gap[1]
                interface._core.session.stamp(keys_of("n"))
                space["n"] = 2
                eventually(lambda: ask.json("series", path="n")["losses"][-1][2] == 1)
    expect(page.locator("#banner")).to_contain_text("reem browse")
    others = ("Failed to load", "ERR_")  # what the browser itself says of a lost connection
    assert not [it for it in visitor.said if it.startswith("error: ") and not any(each in it for each in others)]
    visitor.contexts[0].close()


def test_a_deep_link_opens_the_branches_above_and_marks_its_row(visit, kvs, key):
    kvs[key()] = {"a key": {"list": [{"x": number} for number in range(250)]}}
    for number in range(40):
        kvs[key(f"other{number}")] = 1
    inner = f'{key()}["a key"].list[230]'
    page = visit.open("/view/" + inner + ".x")
    expect(page.locator("h1")).to_have_text(inner + ".x")
    wanted = page.locator("#tree .row[aria-selected=true]")
    expect(wanted).to_have_count(1)
    expect(wanted).to_be_in_viewport()
    assert wanted.get_attribute("data-address") == inner + ".x"


LABELS = """async (values) => {
  const { Plot } = await import("/static/plot.js");
  const said = [];
  const before = CanvasRenderingContext2D.prototype.fillText;
  CanvasRenderingContext2D.prototype.fillText = function (text, x) {
    if (this.textAlign === "right") said.push(text);
  };
  const box = document.createElement("div");
  box.style.cssText = "position: fixed; inset: 0";
  document.body.append(box);
  const plot = new Plot(box);
  said.length = 0;
  plot.set({ names: [""], times: [0, 1], lines: [values] });
  CanvasRenderingContext2D.prototype.fillText = before;
  return said;
}"""
CLOSE = [[0.3, 0.30000000000000004], [1e9, 1e9 + 1e-6], [5.0, 5.0], [-1e-300, 1e-300], [1e300, 1.0000000000001e300]]


def test_the_labels_of_a_nearly_constant_plot_differ(visit):
    page = visit.open("/")
    for values in CLOSE:
        labels = page.evaluate(LABELS, values)
        assert len(labels) >= 2
        assert len(set(labels)) == len(labels), labels


GAP = """async () => {
  const { Plot } = await import("/static/plot.js");
  const box = document.createElement("div");
  box.style.cssText = "position: fixed; inset: 0";
  document.body.append(box);
  const axis = { plots: new Set(), full: [0, 10], shown: null, hover: null };
  const plot = new Plot(box, { axis });
  plot.set({ names: [""], times: [0, 9], lines: [[1, 1]], start: 0, end: 10, losses: [[4, 6, 3]], quiet: [[0, 3]] });
  const { x, y } = plot.place(plot.width, plot.height), ratio = plot.ratio;
  const blue = getComputedStyle(box).getPropertyValue("--curve-0");
  const colour = [1, 3, 5].map((at) => parseInt(blue.slice(at, at + 2), 16));
  const { width, height } = plot.canvas, copy = Object.assign(document.createElement("canvas"), { width, height });
  const copied = copy.getContext("2d", { willReadFrequently: true });
  copied.drawImage(plot.canvas, 0, 0);
  const drawn = (from, to) => {
    const across = Math.round((x(to) - x(from)) * ratio), top = Math.round((y(1) - 2) * ratio);
    const { data } = copied.getImageData(Math.round(x(from) * ratio), top, across, 4);
    const near = (at) => colour.every((part, index) => Math.abs(data[at * 4 + index] - part) < 40);
    const columns = Array.from({ length: across }, (_, at) => [0, 1, 2, 3].some((up) => near(up * across + at)));
    return columns.filter(Boolean).length / across;
  };
  const parts = { whole: drawn(7, 8), lost: drawn(4.5, 5.5), quiet: drawn(1, 2) };
  return { ...parts, said: plot.where(5), note: plot.note.textContent };
}"""


def test_a_plot_has_a_gap_where_updates_were_lost_and_dots_where_none_came(visit):
    """An outage was a flat line, as if the value had been the same."""
    drawn = visit.open("/").evaluate(GAP)
    assert drawn["whole"] == 1
    assert drawn["lost"] == 0
    assert 0.1 < drawn["quiet"] < 0.9
    assert "3 updates lost" in drawn["said"]
    assert "updates were lost" in drawn["note"]
    assert "no update came" in drawn["note"]


@pytest.mark.long
def test_plots_zoom_together_share_a_cursor_and_take_other_keys(visit, address, pspace, key, tmp_path):
    for number in range(25):
        pspace[key()] = {"x": float(number), "y": number - 12.0}
        time.sleep(0.03)
    page = visit.open(f"/view/{key()}")
    plots, legends = page.locator(".pane canvas"), page.locator(".pane .legend")
    expect(plots).to_have_count(2)
    everything = page.get_by_role("button", name="Show all of it again")
    expect(everything).to_have_count(0)
    expect(plots.nth(0)).to_be_visible()
    box = plots.nth(0).bounding_box()
    plots.nth(0).hover(position={"x": box["width"] - 20, "y": 50})
    expect(legends.nth(1)).to_have_text(re.compile(r"-?\d"))  # the cursor is in all plots
    with page.expect_request(lambda request: "/api/series" in request.url and "start=" in request.url):
        page.keyboard.down("Control")
        page.mouse.wheel(0, -200)
        page.keyboard.up("Control")
    expect(everything).to_have_count(2)
    everything.nth(1).click()
    expect(everything).to_have_count(0)
    box = page.locator("#activity").bounding_box()
    page.locator("#activity").hover(position={"x": box["width"] - 4, "y": 5})
    expect(legends.nth(0)).to_have_text(re.compile(r"\d"))  # and the slider's strip moves it

    page = visit.open(f"/view/{key()}.y")
    page.get_by_role("button", name="Logarithmic axis").click()
    expect(page.locator(".plot-note")).to_contain_text("no place on a log axis")
    for _ in range(2):
        expect(page.get_by_role("button", name="Logarithmic axis")).to_have_attribute("aria-pressed", "true")
        page.reload()
    page.get_by_role("button", name="Draw another key in this plot").click()
    page.get_by_label("Key to draw in this plot").fill("nothing.here")
    page.keyboard.press("Enter")
    expect(page.locator("#toast")).to_have_text("No numbers at nothing.here")
    page.get_by_role("button", name="Draw another key in this plot").click()
    page.get_by_label("Key to draw in this plot").fill(f"{key()}.x")
    page.keyboard.press("Enter")
    lines = page.locator(".legend button[aria-pressed]")
    expect(lines).to_have_text([re.compile(rf"^{key()}\.{name} ") for name in "yx"])
    box = page.locator("canvas.plot").bounding_box()
    page.mouse.move(box["x"] + box["width"] * 0.3, box["y"] + 100)
    page.mouse.down()
    page.mouse.move(box["x"] + box["width"] * 0.6, box["y"] + 110, steps=3)
    page.mouse.up()
    everything = page.get_by_role("button", name="Show all of it again")
    expect(everything).to_be_visible()
    expect(page.locator("#live")).to_have_attribute("aria-pressed", "true")  # dragging is no click
    page.keyboard.press("0")
    page.get_by_role("button", name=f"Take {key()}.x out of this plot").click()
    expect(lines).to_have_count(0)

    with client_of(address) as ask:
        (tmp_path / "run.mcap").write_bytes(ask.http.get("/api/recording").content)
    with served(lambda: LogSource(tmp_path / "run.mcap")) as (recorded, _):
        page = visit.open(f"/view/{key()}", address=recorded)
        everything = page.get_by_role("button", name="Show all of it again")
        expect(page.locator(".pane canvas.plot")).to_have_count(2)
        row(page, key()).locator(".twist").click()
        row(page, f"{key()}.y").drag_to(page.locator(".pane canvas.plot").first)
        first = page.locator(".pane").first.locator(".legend button[aria-pressed]")
        expect(first).to_have_text([re.compile(rf"^{key()}\.{name} ") for name in "xy"])
        box = page.locator(".pane canvas.plot").first.bounding_box()
        page.mouse.move(box["x"] + box["width"] - 20, box["y"] + 50)
        with page.expect_request(lambda request: "/api/series" in request.url and "start=" in request.url):
            page.keyboard.down("Control")
            page.mouse.wheel(0, -200)
            page.keyboard.up("Control")
        expect(everything).to_have_count(2)
        page.context.close()


@pytest.mark.long
def test_numbers_are_short_and_all_their_digits_are_there_on_hover(visit, kvs, key):
    kvs[key()] = {
        "pi": 3.141592653589793,
        "stamp": 1764022683.123456,
        "q": [0.123456789012, 2.5],
        "t": np.full((3, 2), 1 / 3),
    }
    page = visit.open(f"/view/{key()}.pi")
    expect(page.locator(".big")).to_have_text("3.14159")
    expect(page.locator(".big")).to_have_attribute("title", "3.141592653589793")
    for name, short, whole in (
        ("pi", "3.14159", "3.141592653589793"),
        ("stamp", "1764022683.1", "1764022683.123456"),
        ("q", "[0.123457, 2.5]", "[0.123456789012, 2.5]"),
    ):
        value = row(page, f"{key()}.{name}").locator(".value")
        expect(value).to_have_text(short)
        expect(value).to_have_attribute("title", re.compile(re.escape(whole)))
    page = visit.open(f"/view/{key()}.t")
    expect(page.locator("td").first).to_have_text("0.333333")
    expect(page.locator("td").first).to_have_attribute("title", "0.3333333333333333")
    expect(page.locator(".facts dd").first).to_have_text("0.333333")


def test_keys_with_a_dot_are_shown_as_paths_write_them(kvs, address, key):
    name = key("m.a")
    kvs[name] = {"x.y": 1, "plain": [2]}
    with client_of(address) as ask:
        eventually(lambda: f'["{name}"]' in ask.rows())
        assert list(ask.rows(f'["{name}"]')) == ['["x.y"]', "plain"]
        assert list(ask.rows(f'["{name}"].plain')) == ["[0]"]


# --- a dashboard -------------------------------


def keep_publishing(page, work, until):
    for number in range(200):
        work(number)
        page.wait_for_timeout(50)
        if number > 20 and until():
            return
    raise AssertionError("it did not appear")


@pytest.mark.long
def test_small_vectors_are_drawn_over_time_and_lines_can_be_hidden(visit, pspace, key):
    pspace[key()] = {"v": np.array([1.0, 2.0, 30.0])}
    page = visit.open(f"/view/{key()}.v")
    entries = page.locator("#view .card:not([hidden]) .legend button")
    keep_publishing(
        page,
        lambda number: pspace[key()].__setitem__("v", np.array([1.0, 2.0, 30.0 + number])),
        lambda: entries.count() == 3,
    )
    expect(entries.nth(2)).to_have_attribute("aria-pressed", "true")
    entries.nth(2).click()
    expect(entries.nth(2)).to_have_attribute("aria-pressed", "false")
    for number in range(10):
        pspace[key()]["v"] = np.array([1.0, 2.0, number])
        page.wait_for_timeout(30)
    expect(entries.nth(2)).to_have_attribute("aria-pressed", "false")


@pytest.mark.long
def test_the_page_of_a_dict_has_its_pictures_and_plots_together_and_rows_for_the_rest(visit, pspace, key):
    rows = np.add.outer(np.arange(40), np.arange(60)).astype(np.uint8)
    pspace[key()] = {"image": rows, "x": 1.0, "q": [1.0, 2.0], "name": "arm", "deep": {"a": 1}}
    page = visit.open(f"/view/{key()}")
    keep_publishing(
        page,
        lambda number: pspace[key()].__setitem__("x", float(number)),
        lambda: page.locator(".pane canvas").count() >= 1,
    )
    pspace[key()]["q"] = [1.0, 3.0]
    expect(page.locator(".pane .pane-head a")).to_have_text(["image", "x", "q"])
    expect(page.locator(".pane img")).to_have_js_property("naturalWidth", 60)
    assert page.locator("#view .row").evaluate_all("rows => rows.map(row => row.dataset.address)") == [
        f"{key()}.name",
        f"{key()}.deep",
    ]


@pytest.mark.long
def test_a_depth_image_with_holes_and_a_path_of_points(visit, pspace, key):
    depth = np.full((480, 640), 1.5, np.float32)
    depth[:10, :10] = np.nan
    pspace[key()] = {"depth": depth, "path": np.cumsum(np.ones((40, 2)), 0)}
    page = visit.open(f"/view/{key()}.depth")
    expect(page.locator(".facts")).to_contain_text("NaN or infinite100")
    expect(page.locator("#view")).to_contain_text("100 are NaN or infinite: magenta.")
    page = visit.open(f"/view/{key()}")
    expect(page.locator(".pane img")).to_have_count(1)
    expect(page.locator(".pane canvas")).to_have_count(1)
    expect(page.locator(".pane .legend")).to_contain_text("[1]")


@pytest.mark.long
def test_the_first_page_shows_what_is_pinned_and_busy_keys_but_no_clocks_and_counters(visit, pspace, key):
    pspace[key("busy")] = {"x": 0.0}
    pspace[key("quiet")] = {"y": 5.0}
    page = visit.open("/")
    busy = page.locator(f'.pane .pane-head a[title="{key("busy")}.x"]')

    numbers = itertools.count()

    def publish(_):
        number, stamp = next(numbers), time.time()
        pspace[key("busy")] = {"x": float(number % 7), "seq": number, "stamp": stamp, "nanoseconds": int(stamp * 1e9)}

    keep_publishing(page, publish, lambda: busy.count() == 1)
    heads = page.locator("#view h2:visible")
    titles = page.locator(".pane .pane-head a")
    expect(heads).to_have_text("Busiest keys")
    page.goto(page.url + f"view/{key('quiet')}.y")
    page.get_by_role("button", name="Pin", exact=True).click()
    page.locator("a.brand").click()
    keep_publishing(page, publish, lambda: titles.count() == 2)
    expect(heads).to_have_text(["Pinned", "Busiest keys"])
    expect(titles).to_have_text([f"{key('quiet')}.y", f"{key('busy')}.x"])
    page.get_by_label("busiest keys").uncheck()
    expect(titles).to_have_text([f"{key('quiet')}.y"])
    page.locator(".pin").click()
    expect(heads).to_have_count(0)


@pytest.mark.long
def test_a_layout_is_saved_by_a_name_and_an_address_leads_to_it(visit, pspace, kvs, key):
    pspace[key()] = {"y": 5.0, "list": [1, 2], 'an "odd" [key]': {"z": 1.5}}
    name = key()
    far = visit.open(f"/view/{name}.list[{2**63 - 1}]")  # of an address, too, which others have written
    expect(row(far, f"{name}.list[1]")).to_be_visible()
    page = visit.open(f"/view/{name}.y")
    page.get_by_role("button", name="Pin", exact=True).click()
    page.get_by_role("button", name="Logarithmic axis").click()
    page.locator("a.brand").click()
    page.get_by_role("button", name="Save…").click()
    page.get_by_label("Name of the layout").fill("a.b")
    page.get_by_role("button", name="Save", exact=True).click()
    expect(page.locator(".save-layout .wrong")).to_contain_text("Use up to 60 letters")
    page.get_by_label("Name of the layout").fill(name)
    page.get_by_role("button", name="Save", exact=True).click()
    expect(page).to_have_url(re.compile(rf"\?layout={name}$"))
    expected = {"pins": [f"{name}.y"], "plots": {f"{name}.y": {"log": True}}, "overlays": {}, "busiest": True}
    assert kvs["_layouts"][name].read() == expected
    kvs["_layouts"]["hostile"].write({"pins": {"x": 1}, "plots": [1], "overlays": 3, "busiest": "x"})
    kvs["_layouts"]["array"].write({"pins": np.zeros(3)})
    kvs["_layouts"]["large"].write({"pins": ["x" * 40_000]})

    other = visit.open(f"/?layout={name}")
    expect(other.locator(".pane .pane-head a")).to_have_text([f"{name}.y"])
    expect(other.get_by_role("button", name="Logarithmic axis")).to_have_attribute("aria-pressed", "true")
    other.locator(".pin").click()
    expect(other.get_by_label("Layout", exact=True).locator("option:checked")).to_have_text(f"{name} (changed)")
    expect(other.get_by_label("Layout", exact=True).locator("option")).to_have_text(
        ["own", f"{name} (changed)", "hostile"]
    )
    other.get_by_label("Layout", exact=True).select_option("saved hostile")
    expect(other.locator(".pane")).to_have_count(0)
    other.get_by_label("Layout", exact=True).select_option("own")
    assert (
        other.evaluate("localStorage.getItem('reem:layout:' + JSON.parse(document.body.dataset.config).title)") is None
    )
    link = "#layout=" + quote(json.dumps(expected | {"busiest": False}))
    linked = visit.open("/" + link)
    expect(linked.locator(".pane .pane-head a")).to_have_text([f"{name}.y"])
    expect(linked.get_by_label("busiest keys")).not_to_be_checked()

    page.get_by_role("button", name="Save…").click()
    page.get_by_role("button", name="Remove", exact=True).click()
    expect(page.locator("#toast")).to_have_text("Removed from the store")
    assert name not in kvs["_layouts"].read()
    kvs["_layouts"].delete()


def test_the_first_page_lists_services(visit, kvs, key):
    with kvs[key()].serve(lambda x: 1 / x):
        page = visit.open("/")
        row = page.locator(".services tbody tr").filter(has_text=key())
        expect(row.locator("td").last).to_have_text("0")
        for x in (1, 0):
            with contextlib.suppress(RemoteError):
                kvs[key()].call(x=x)
        expect(row.locator("td").last).to_have_text("1")
        expect(row.locator("td").nth(4)).to_have_text(re.compile(r"\d ms"))


@pytest.mark.long
def test_panes_are_moved_by_dragging_and_the_edge_as_well(visit, kvs, key):
    kvs[key()] = {"a": np.zeros((20, 20)), "b": np.zeros((20, 20))}
    page = visit.open(f"/view/{key()}")
    titles = page.locator(".pane .pane-head a")
    expect(titles).to_have_text(["a", "b"])
    page.locator(".pane-head").nth(0).drag_to(page.locator(".pane").nth(1))
    expect(titles).to_have_text(["b", "a"])
    before = page.locator("#tree-panel").bounding_box()["width"]
    edge = page.locator("#edge").bounding_box()
    page.mouse.move(edge["x"] + 1, 300)
    page.mouse.down()
    page.mouse.move(edge["x"] + 121, 300, steps=4)
    page.mouse.up()
    wide = page.locator("#tree-panel").bounding_box()["width"]
    assert wide == pytest.approx(before + 120, abs=8)
    page.reload()
    expect(titles).to_have_text(["a", "b"])
    assert page.locator("#tree-panel").bounding_box()["width"] == pytest.approx(wide, abs=2)


@pytest.mark.parametrize(
    ("hint", "value", "shapes"),
    [
        ("det", [1, 2, 3, 4], [([1, 2, 3, 4], "")]),
        ("xywh det", np.array([[1, 2, 3, 4, 0.5]]), [([1, 2, 4, 6], "0.50")]),
        ("points det", np.array([[1.0, 2.0], [np.nan, 3.0]]), [([1, 2], "")]),
        ("cxcywh det", {"boxes": [[5, 5, 4, 2]], "labels": ["cup"], "scores": [0.9]}, [([3, 4, 7, 6], "cup 0.90")]),
        (
            "det",
            [{"x": 1, "y": 2, "w": 3, "h": 4, "label": "ball"}, {"x": 5, "y": 6}],
            [([1, 2, 4, 6], "ball"), ([5, 6], "")],
        ),
        ("det", [], []),
    ],
)
def test_what_an_overlay_names_is_drawn(hint, value, shapes):
    (parsed,) = hints_of(hint)
    assert shapes_of(parsed, value) == shapes


def test_an_overlay_of_an_image_takes_little_memory():
    image = np.ones((1000, 1000, 3), np.uint8)
    tracemalloc.start()
    try:
        assert len(shapes_of(hints_of("det")[0], {"points": image})) == 500
        assert tracemalloc.get_traced_memory()[1] < 10 << 20
    finally:
        tracemalloc.stop()


def test_an_overlay_that_is_none_is_refused():
    for text in ("", "boxes points det", "boxes xywh cxcywh det", "x" * 600, "a;" * 20, "boxes a..b"):
        with contextlib.suppress(BadInput):
            assert hints_of(text) == [], text
    for value in ("text", 5, {"a": 1}, [[1]], [["x", "y"]], {"box": [1, 2, 3]}, None, b"bytes", [[[{"q": 1}]]]):
        with pytest.raises(BadValue, match="det"):
            shapes_of(hints_of("boxes det")[0], value)
    deep = []
    for _ in range(100_000):
        deep = [deep]
    with pytest.raises(BadValue, match="deep"):
        shapes_of(hints_of("det")[0], deep)


@pytest.mark.long
def test_boxes_are_drawn_over_a_picture_by_a_hint_that_is_typed_once(visit, pspace, key):
    pspace[key()] = {"image": np.zeros((40, 60), np.uint8), "boxes": [[10, 10, 30, 30]]}
    page = visit.open(f"/view/{key()}.image")
    page.get_by_label("Overlay").fill(f"boxes {key()}.boxes")
    page.keyboard.press("Enter")
    inked = """it => {
        const { width, height } = it, copy = Object.assign(document.createElement("canvas"), { width, height });
        const context = copy.getContext("2d", { willReadFrequently: true });
        context.drawImage(it, 0, 0);
        const at = (x, y) => context.getImageData(Math.round(x * width), Math.round(y * height), 1, 1).data[3] > 0;
        return [at(10 / 60, 0.5), at(0.5, 0.25), at(20 / 60, 0.5), at(0.9, 0.5)];
    }"""
    drawn = page.locator("canvas.overlay")
    eventually(lambda: drawn.evaluate(inked) == [True, True, False, False] or page.wait_for_timeout(50))
    page.goto(f"{visit.address}/view/{key()}")
    expect(drawn).to_have_count(1)
    expect(drawn).to_be_visible()
    eventually(lambda: drawn.evaluate(inked)[0] or page.wait_for_timeout(50))
    page.goto(f"{visit.address}/view/{key()}.image")
    page.get_by_label("Overlay").fill(f"nothing.here; {key()}.boxes")
    page.keyboard.press("Enter")
    expect(page.locator("#view .card .wrong")).to_contain_text("nothing.here")
    expect(drawn).to_be_visible()


@pytest.mark.long
def test_the_value_under_the_pointer_is_told(visit, kvs, key):
    image = np.zeros((40, 60, 3), np.uint8)
    image[20, 30] = 7, 8, 9
    kvs[key()] = {"image": image, "depth": np.arange(1200, dtype=np.float32).reshape(30, 40)}
    for name, (width, height), told in (
        ("image", (60, 40), "row 20, column 30: [7, 8, 9]"),
        ("depth", (40, 30), "row 15, column 20: 620"),
    ):
        page = visit.open(f"/view/{key()}.{name}")
        expect(page.locator(".picture img")).to_have_js_property("naturalWidth", width)
        box = page.locator(".picture img").bounding_box()
        page.locator(".picture img").hover(
            position={"x": box["width"] * (width / 2 + 0.5) / width, "y": box["height"] * (height / 2 + 0.5) / height}
        )
        expect(page.locator(".pixel")).to_have_text(told)
