"""Arrays of the past: a picture for each instant, with its age, within the bytes there are."""

import asyncio
import os
import time

import numpy as np
import pytest
from browserkit import client_of, served
from picturekit import look_back, running_robot

from reem_async import RedisInterface
from reem_async.plan.placeholders import Unfetched
from reem_async.plan.trees import MISSING
from reem_async.tools.browser import LiveSource
from reem_async.tools.browser.follower import Follower
from reem_async.tools.browser.history import Frames, History
from reem_async.tools.browser.pictures import paint, preview_of
from reem_async.tools.browser.timeline import PENDING
from reem_async.tools.browser.trees import Frame, described, framed

DEFAULT_BUDGET, DEFAULT_SECONDS = 128 << 20, 60


@pytest.mark.long
def test_the_slider_of_a_robot_with_two_cameras_has_a_picture_for_each_instant(server_url, key):
    """640x480x3 at 30 Hz and depth at 10 Hz: it had 7 pictures at 155 instants, and none of depth.

    A twelfth of the default time in a twelfth of the default memory; all of it with REEM_TEST_SLIDER=60.
    """
    seconds = int(os.environ.get("REEM_TEST_SLIDER", "5"))
    make = lambda: LiveSource(RedisInterface(server_url), seconds, DEFAULT_BUDGET * seconds // DEFAULT_SECONDS)  # noqa: E731
    with (
        served(make) as (address, source),
        running_robot(server_url, key()),
        client_of(address) as ask,
        client_of(address) as page,
        page.http.stream("GET", "/api/events"),  # as an open page does: else arrays are read less often
    ):
        deadline = time.monotonic() + 30
        while time.monotonic() < deadline and key() not in ask.rows():
            time.sleep(0.1)
        time.sleep(seconds + 1.5)
        for name in ("camera", "depth"):
            span = ask.json("tree", open="1:0:")
            answers = look_back(ask, f"{key()}.{name}.image", span["start"] + 1, span["end"], 31)
            pictures = [answer for answer in answers if answer is not None]
            assert len(pictures) >= 30, f"{name}: {len(pictures)} of 31"
            assert all(answer["age"] is not None and answer["age"] < seconds for answer in pictures), name
            assert all(answer["size"] == [640, 480] for answer in pictures)
            assert any(answer["preview"] for answer in pictures), "all of them fit: this shows nothing"
        assert source.history.bytes <= source.history.budget
        assert span["end"] - span["start"] >= seconds - 0.5
        kept = ask.json("activity", bins=10, path=key())["pictures"]
        assert min(kept) >= 1, "the strip shows where they are"
        assert max(kept) == 2
        assert ask.json("activity", bins=10, path="nothing")["pictures"] == []


def test_reading_arrays_ends_though_news_come_as_it_is_cancelled(server_url):
    """`reem browse` went on for ever after SIGTERM now and then: the cancellation was lost."""

    async def work():
        follower = Follower(RedisInterface(server_url), History(1.0, 2_000_000))
        assert follower.arrays.take(1_000_000)
        follower.key("camera").owed["numpy", ".image"] = Unfetched("numpy", 500_000, "")
        follower._owing["camera"] = None
        task = asyncio.create_task(follower._read_arrays())
        await asyncio.sleep(0.02)
        follower._owes.set()
        task.cancel()
        done, _ = await asyncio.wait([task], timeout=5)
        assert done
        assert task.cancelled()

    asyncio.run(work())


def picture(value):
    return np.full((480, 640, 3), value, np.uint8)


@pytest.mark.parametrize("seconds", [10, 100, 1000])
def test_pictures_are_thinned_evenly_as_room_runs_short(seconds):
    history = History(float(seconds), 2_000_000)
    history.start = 0.0
    history.begin("robot", b'{"camera": null, "cloud": null}')
    for number in range(500):
        at = number * seconds / 500
        history.add_read(("robot", "camera"), Frame(picture(number % 256)), at)
        history.add_read(("robot", "cloud"), Frame(np.full(10_000, number, np.float64)), at)
        assert history.bytes <= history.budget
    for path in (("robot", "camera"), ("robot", "cloud")):
        instants = np.linspace(seconds / 50, seconds * 0.99, 155)
        kept = [history.kept(path, at) for at in instants]
        assert all(isinstance(it.value, Frame) for it in kept)
        ages = [at - it.value.time for at, it in zip(instants, kept, strict=True)]
        assert max(ages) < seconds / 3, "one place was thinned more than others"
    cloud = [frame.time for frame in history.frames.concerning(("robot", "cloud"))]
    gaps = np.diff(cloud)
    assert gaps.max() <= 4 * np.median(gaps)


def test_a_frame_whose_content_is_gone_comes_back_as_no_picture():
    """An array that did not change stands in each tree that is read."""
    frames, frame = Frames(10.0), framed(np.zeros((4, 4)))
    for when in (1.0, 2.0):
        frames.add(("a",), frame, when)
        frames.thin(0, when)
        assert (list(frames.concerning(("a",))), frames.bytes) == ([], 0)


def test_the_last_frame_is_shown_with_its_age_where_the_newest_is_not_kept():
    history = History(1000.0, 1 << 24)
    history.start = 0.0
    history.begin("cam", b'{"image": 0, "n": 0}')
    first, small = np.zeros((4, 4), np.uint8), np.full((4, 4), 7, np.uint8)
    history.add_read(("cam", "image"), framed(first), 5.0)
    history.add(("cam", "image"), PENDING, 0, 6.0)
    history.add_read(("cam", "image"), described(first), 6.1, answer=True)
    kept = history.kept(("cam", "image"), 8.0)
    assert kept.value.whole is first
    assert (kept.late, kept.value.time) == (pytest.approx(1.1), 5.0)
    history.add_read(("cam", "image"), framed(small), 9.0)
    assert history.kept(("cam", "image"), 9.5).value.whole is small
    assert history.kept(("cam", "image"), 9.5).late == 0.0
    history.add(("cam", "image"), MISSING, 0, 10.0)
    assert history.kept(("cam", "image"), 11.0).value is MISSING


def test_the_items_of_a_list_that_moved_do_not_get_each_others_pictures():
    history = History(1000.0, 1 << 24)
    history.start = 0.0
    images = [np.full((4, 4), value, np.uint8) for value in (1, 2)]
    history.add_read(("l",), framed(images), 1.0)
    history.add(("l", 0), MISSING, 0, 2.0)
    assert history.kept(("l", 0), 1.5).value.whole is images[0]
    found = history.kept(("l", 0), 2.5).value
    assert isinstance(found, Unfetched) or found.whole is images[1]


def test_frames_that_nobody_can_see_are_let_go_of():
    history = History(10.0, 1 << 24)
    history.start = 0.0
    for number in range(300):
        history.add_read((f"key{number % 3}",), framed(np.zeros(1000)), float(number))
    one = next(history.frames.concerning(("key0",))).size
    assert history.frames.bytes <= 20 * one
    for number in range(3):
        history.add((f"key{number}",), MISSING, 0, 300.0 + number)
    for number in range(40):
        history.add(("other",), number, 8, 310.0 + number)
    assert history.frames.bytes == 0
    assert list(history.frames.concerning(())) == []


def test_what_is_counted_is_what_is_held():
    frames = Frames(100.0)
    for number in range(60):
        frames.add(("a", number % 4), framed(np.random.default_rng(number).random((40, 50 + number))), float(number))
    for most in (600_000, 200_000, 50_000, 1000, 0):
        frames.thin(most, 60.0)
        assert frames.bytes == sum([frame.size for frame in frames.concerning(())])
        assert frames.bytes <= most


@pytest.mark.parametrize("kind", ["uint8", "rgba", "bool", "int16", "float32", "nan", "huge", "one"])
def test_a_preview_looks_like_the_array(kind):
    rows, columns = np.mgrid[0:300, 0:400]
    smooth = np.sin(columns / 40) + rows / 100
    array = {
        "uint8": (100 + 40 * smooth).astype(np.uint8)[:, :, None].repeat(3, 2),
        "rgba": (100 + 20 * smooth).astype(np.uint8)[:, :, None].repeat(4, 2),
        "bool": smooth > 1,
        "int16": (3000 * smooth).astype(np.int16),
        "float32": smooth.astype(np.float32),
        "nan": np.where(smooth > 2, np.nan, smooth),
        "huge": smooth * 4e307,
        "one": np.full((300, 400), 3.5),
    }[kind]
    preview = preview_of(array)
    assert len(preview.file) < array.nbytes / 2
    small, whole = preview.paint("grey", None, None, side=100, bgr=False), paint(array, side=100)
    assert small.size == whole.size == (400, 300)
    assert (small.low, small.high, small.bad) == (whole.low, whole.high, whole.bad)
    apart = np.abs(pixels(small.file).astype(int) - pixels(whole.file))
    assert np.percentile(apart, 90) <= 12


def pixels(png):
    import io

    from PIL import Image

    return np.asarray(Image.open(io.BytesIO(png)).convert("RGB").resize((100, 75)))


def test_what_is_no_picture_has_no_preview():
    for array in (np.zeros(10), np.zeros((5, 5)), np.array(["a"]), np.zeros((0, 3)), np.zeros((100, 100), complex)):
        assert preview_of(array) is None
