"""Arrays on the screen: pictures, slices, tables, lines, histograms."""

import io

import numpy as np
import pytest
from PIL import Image

from reem_async.errors import BadValue
from reem_async.tools.browser.arrays import histogram, line, statistics, table
from reem_async.tools.browser.pictures import MAPS, colours_of, look_at, paint, parse_slice, part

MAGENTA = (255, 0, 255)


def pixels(picture):
    with Image.open(io.BytesIO(picture.file)) as image:
        return np.asarray(image)


def test_bytes_are_shown_as_they_are():
    rgb = np.random.default_rng(0).integers(0, 256, (20, 30, 3), np.uint8)
    assert (pixels(paint(rgb)) == rgb).all()
    assert (pixels(paint(rgb, bgr=True)) == rgb[:, :, ::-1]).all()
    rgba = np.random.default_rng(0).integers(0, 256, (20, 30, 4), np.uint8)
    assert (pixels(paint(rgba)) == rgba).all()
    assert (pixels(paint(rgba, bgr=True))[:, :, [2, 1, 0, 3]] == rgba).all()
    grey = rgb[:, :, 0]
    assert (pixels(paint(grey)) == grey[:, :, None]).all()
    assert (pixels(paint(grey[:, :, None])) == grey[:, :, None]).all()


def test_numbers_are_given_colours_from_the_lowest_to_the_highest():
    plane = np.linspace(-3, 5, 256, dtype=np.float32).reshape(16, 16)
    picture = paint(plane, "viridis")
    assert (picture.low, picture.high, picture.bad, picture.size) == (-3.0, 5.0, 0, (16, 16))
    shown = pixels(picture)
    assert shown[0, 0].tolist() == [0x44, 0x01, 0x54]
    assert shown[-1, -1].tolist() == [0xFD, 0xE7, 0x25]
    assert (pixels(paint(plane, "viridis", 5, 9)) == shown[0, 0]).all(), "all below the range"


@pytest.mark.parametrize("dtype", ["bool", "int8", "uint16", "int64", "uint64", "float16", "float32", "float64", ">f8"])
def test_every_plain_dtype_is_a_picture(dtype):
    plane = np.array([[0, 1], [1, 0]]).astype(dtype)
    shown = pixels(paint(plane, "grey"))
    assert shown[0, 0].tolist() == [0, 0, 0]
    assert shown[0, 1].tolist() == [255, 255, 255]


def test_nan_and_infinity_are_magenta_and_do_not_spoil_the_range():
    plane = np.array([[0.0, 1.0, np.nan], [np.inf, -np.inf, 0.5]])
    picture = paint(plane, "grey")
    assert (picture.low, picture.high, picture.bad) == (0.0, 1.0, 3)
    shown = pixels(picture)
    assert [tuple(shown[place]) for place in ((0, 2), (1, 0), (1, 1))] == [MAGENTA] * 3
    assert tuple(shown[0, 1]) == (255, 255, 255)
    assert (pixels(paint(np.full((3, 3), np.nan), "grey")) == MAGENTA).all()
    colour = np.zeros((2, 2, 3))
    colour[0, 0, 1] = np.nan
    assert tuple(pixels(paint(colour))[0, 0]) == MAGENTA


def test_extreme_numbers():
    largest = np.finfo(np.float64).max
    shown = pixels(paint(np.array([[-largest, largest]]), "grey"))
    assert shown[0].tolist() == [[0, 0, 0], [255, 255, 255]]
    assert pixels(paint(np.full((2, 2), 7), "grey")).shape == (2, 2, 3)


def test_large_pictures_are_scaled_down_to_the_screen():
    picture = paint(np.zeros((3000, 1000), np.uint8), side=500)
    assert picture.size == (1000, 3000)
    assert pixels(picture).shape[0] <= 500
    assert pixels(paint(np.zeros((1000, 3000)), side=500)).shape[1] <= 500


def test_what_is_no_picture_is_refused():
    for array in (np.zeros(5), np.zeros((2, 2, 2)), np.zeros((0, 5)), np.array([["a"]]), np.zeros((2, 2), complex)):
        with pytest.raises(BadValue, match="picture"):
            paint(array)
    with pytest.raises(BadValue, match="no colour map"):
        paint(np.zeros((2, 2)), "rainbow")
    assert all(len(colours_of(name)) == 64 for name in MAPS)


def test_only_colours_of_a_smaller_picture_may_be_coarse():
    slope = np.stack([np.add.outer(np.arange(480), np.arange(640)) // 5] * 3, axis=2).astype(np.uint8)
    exact, coarse = paint(slope, side=480), paint(slope, side=480, coarse=True)
    assert coarse.file.startswith(b"\xff\xd8\xff")
    assert np.abs(pixels(coarse).astype(int) - pixels(exact)).max() < 16
    for plane, side in ((slope, 640), (slope[:, :, 0], 480), (slope.astype("f4"), 480)):
        assert paint(plane, side=side, coarse=True) == paint(plane, side=side)


@pytest.mark.parametrize(
    ("dtype", "shape", "view"),
    [
        ("u1", (480, 640, 3), "image"),
        ("u1", (480, 640), "image"),
        ("f4", (480, 640), "image"),
        ("f4", (8, 480, 640), "image"),
        ("f8", (500, 3), "line"),
        ("f8", (4, 4), "table"),
        ("f8", (6,), "table"),
        ("f8", (1000,), "line"),
        ("c16", (1000,), "table"),
        ("U5", (1000,), "table"),
        ("f8", (0,), ""),
        ("f8", (), "table"),
        ("f8", (0, 5, 3), ""),
    ],
)
def test_the_first_view_says_most(dtype, shape, view):
    array = np.zeros(shape, dtype)
    look = look_at(array.dtype, shape)
    assert look.view == view
    for name, chosen in look.views.items():
        plane = part(array, chosen)
        assert plane.ndim <= {"image": 3, "line": 2, "table": 2}.get(name, 99)
        assert parse_slice(",".join(":" if each is None else str(each) for each in chosen), shape, 99) == chosen


@pytest.mark.parametrize("text", ["", ":", ":,:,:,:", "0,0,99", "a,:,:", "1e3,:,:", "0:1,:,:", "--1,:,:", ":,:,:"])
def test_slices_that_mean_nothing_are_refused(text):
    with pytest.raises(BadValue, match=r"slice|index"):
        parse_slice(text, (4, 5, 6), 2)


def test_slices():
    assert parse_slice(" -1 , : , 2", (4, 5, 6), 2) == (-1, None, 2)
    assert part(np.arange(24).reshape(2, 3, 4), (1, None, -1)).tolist() == [15, 19, 23]


def test_a_table_shows_a_page_whatever_is_asked():
    array = np.arange(1000 * 100).reshape(1000, 100)
    page = table(array, 990, 95, 50, 16)
    assert (page["shape"], page["row"], page["column"], page["columns"]) == ([1000, 100], 990, 95, 5)
    assert page["cells"][0][0] == "99095"
    assert len(table(array, 0, 0, 10**9, 10**9)["cells"]) <= 200
    assert table(np.zeros(0), 5, 0, 10, 10)["cells"] == []
    assert table(np.array(3.5), 0, 0, 10, 10)["cells"] == [["3.5"]]
    assert table(np.array([5], "m8[s]"), 0, 0, 5, 5)["cells"] == [["5 seconds"]]
    records = np.array([(1, "a\u202eb")], [("n", int), ("t", "U5")])
    assert "\u202e" not in table(records, 0, 0, 5, 5)["cells"][0][0]


def test_long_lines_keep_their_extremes():
    values = np.zeros(200_000)
    values[123_456], values[50_001], values[7] = 9.0, -9.0, np.nan
    drawn = line(values)
    assert len(drawn["times"]) < 2000
    assert {123_456, 50_001} <= set(drawn["times"])
    many = line(np.random.default_rng(0).normal(size=(5000, 40)))
    assert (len(many["lines"]), many["more"]) == (16, 24)
    assert line(np.array([1.0, np.nan, np.inf]))["lines"] == [[1.0, None, None]]
    assert line(np.full(5000, np.nan))["lines"][0][0] is None


def test_histograms_count_everything():
    values = np.random.default_rng(0).normal(size=10_000)
    assert sum(histogram(values)["counts"]) == 10_000
    assert histogram(np.array([1, 1, 3], np.uint8)) == {"low": 0.5, "high": 3.5, "counts": [2, 0, 1]}
    assert histogram(np.array([np.nan, 2.0, 2.0])) == {"low": 2.0, "high": 2.0, "counts": [2]}
    assert histogram(np.array([np.nan]))["counts"] == []
    for close in ([-1.7e308, 1.7e308], [2**62, 2**62 + 5], [1e16, 1e16 + 2], [0.0, 5e-324]):
        assert histogram(np.array(close))["counts"] == [2], close


def test_statistics():
    said = statistics(np.array([1.0, np.nan, 3.0]))
    assert said == {"bad": 1, "sampled": False, "low": "1", "high": "3", "mean": "2"}
    assert statistics(np.array(["a"])) == {}
    assert statistics(np.zeros(0)) == {}
    assert statistics(np.array([np.nan])) == {"bad": 1, "sampled": False}
