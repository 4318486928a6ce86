"""Pictures as JPEG and PNG: encoded by the publisher, carried as they are, decoded by readers."""

import io
import struct

import numpy as np
import pytest
from browserkit import client_of, live, served
from conftest import aeventually, assert_no_orphans
from PIL import Image

import reem
import reem_async
from reem_async import BadData, BadType, BadValue, Jpeg, Png, Unreadable
from reem_async.ships import images
from reem_async.tools.recording import Recorder, Replayer, open_log

ROWS, COLUMNS = np.mgrid[0:48, 0:64]
FRAME = np.stack([ROWS * 5, COLUMNS * 3, ROWS + COLUMNS], 2).astype(np.uint8)
DEPTH = (ROWS * 1000 + COLUMNS).astype(np.uint16)
RGBA = np.dstack([FRAME, FRAME[:, :, 0]])
LARGE = np.random.default_rng(1).integers(0, 256, (240, 320, 3), np.uint8)  # more than a notice carries


@pytest.fixture(params=["simplejpeg", "pillow", "none"])
def codec(request, monkeypatch):
    """Makes other codecs unavailable; called where the test wants it."""
    real, lacking = images._module, {"pillow": ("simplejpeg",), "none": ("simplejpeg", "PIL.Image")}

    def choose():
        away = lacking.get(request.param, ())
        monkeypatch.setattr(images, "_module", lambda name: None if name in away else real(name))
        return request.param

    return choose


def near(found, image):
    assert (found.dtype, found.shape) == (image.dtype, image.shape)
    assert not found.flags.writeable
    return np.abs(found.astype(int) - image).mean() < 4


@pytest.mark.parametrize(
    "image", [FRAME, FRAME[:, :, 0], FRAME[:, :, :1], FRAME[::-2, ::3], np.full((1, 1), 7, np.uint8)]
)
def test_an_array_comes_back_from_each_codec(codec, image):
    if codec() == "none":
        for make in (Jpeg, Png):
            with pytest.raises(ModuleNotFoundError, match=r"reem-async\[images\]"):
                make(image)
        return
    plane = image[:, :, 0] if image.shape[2:] == (1,) else image
    jpeg, png = Jpeg(image, quality=95), Png(image)
    assert near(jpeg.decode(), plane)
    assert np.array_equal(png.decode(), plane)
    for it in (jpeg, png):
        assert type(it)(bytearray(it.data)) == it, "a file is taken as it is"
        assert bytes(it) == it.data
        assert it.shape == plane.shape
        assert it.summary in repr(it)
    assert len(Jpeg(LARGE, 20).data) < len(Jpeg(LARGE, 90).data)


@pytest.mark.parametrize("image", [DEPTH, DEPTH.astype(">u2"), RGBA, (FRAME > 99).astype(np.uint8)])
def test_png_is_exact(image):
    assert np.array_equal(Png(image).decode(), image)
    assert np.array_equal(Png(image, level=9).decode(), image)


def saved(mode, kind):
    file = io.BytesIO()
    Image.new(mode, (64, 48)).save(file, kind)
    return file.getvalue()


@pytest.mark.parametrize(
    ("make", "given", "error", "words"),
    [
        (Jpeg, (FRAME.astype(float),), BadType, "uint8; use .astype"),
        (Jpeg, (DEPTH,), BadType, "uint8"),
        (Jpeg, (RGBA,), BadValue, "1, 3"),
        (Jpeg, (FRAME[:0],), BadValue, "none of them 0"),
        (Jpeg, (FRAME[0, 0],), BadValue, "rows, columns"),
        (Jpeg, (np.zeros((1, 70_000), np.uint8),), BadValue, "in parts"),
        (Jpeg, (np.ma.array(FRAME),), BadType, "np.asarray"),
        (Jpeg, ([[1]],), BadType, "np.asarray"),
        (Jpeg, (FRAME, 0), BadValue, "1 to 100"),
        (Jpeg, (FRAME, "85"), BadType, "1 to 100"),
        (Jpeg, (b"",), BadValue, "does not begin as a JPEG"),
        (Jpeg, (saved("CMYK", "JPEG"),), BadValue, "not CMYK"),
        (Png, (np.dstack([DEPTH] * 3),), BadValue, "as one of: 1"),
        (Png, (FRAME > 99,), BadType, "uint8 or uint16"),
        (Png, (FRAME, 10), BadValue, "0 to 9"),
        (Png, (saved("P", "PNG"),), BadValue, "colour type 3"),
        (Png, (saved("RGB", "JPEG"),), BadValue, "does not begin as a PNG"),
    ],
)
def test_what_is_no_such_picture_is_refused(make, given, error, words):
    with pytest.raises(error, match=words):
        make(*given)


def claiming(rows, columns, size):
    data = Jpeg(FRAME).data
    place = data.index(b"\xff\xc0") + 5
    return (data[:place] + struct.pack(">HH", rows, columns) + data[place + 4 :]).ljust(size, b"\0")


def test_files_of_strangers_cost_no_more_than_their_bytes(codec):
    """Damage anywhere, cut anywhere, sizes that are not true: BadData, and what claims too much is not decoded."""
    good, png = Jpeg(FRAME).data, Png(FRAME).data
    for size, rows, columns in ((900, 60_000, 60_000), (8_000_000, 60_000, 60_000), (900, 900, 1000), (900, 0, 64)):
        with pytest.raises(BadData, match=r"claims|no pixels"):
            Jpeg.from_file(claiming(rows, columns, size))
    bomb = png[:16] + struct.pack(">II", 60_000, 60_000) + png[24:]
    with pytest.raises(BadData, match="claims"):
        Png.from_file(bomb)
    if codec() == "none":
        with pytest.raises(BadData, match=r"needs simplejpeg or Pillow: pip install"):
            Jpeg.from_file(good).decode()
        return
    random = np.random.default_rng(3)
    for kind, data in ((Jpeg, good), (Png, png)):
        with pytest.raises(BadData):
            kind.from_file(data[: len(data) // 2]).decode()
        for _ in range(200):
            place, byte = random.integers(len(data)), random.integers(256)
            for damaged in (
                data[:place],
                data[:place] + bytes([byte]) + data[place + 1 :],
                data[:2] + random.bytes(30),
            ):
                try:
                    found = kind.from_file(damaged).decode()
                except BadData:
                    continue
                assert found.nbytes <= 2048 * len(damaged)


@pytest.mark.parametrize("image", [FRAME, LARGE], ids=["in the notice", "fetched"])
async def test_every_reader_gets_an_array(image, key, kvs, akvs, apspace, binterface):
    name, before = key("cam"), Jpeg(image)
    mirror, watch = akvs[name].mirror(), akvs[name].watch(reem_async.Every(100))
    await mirror.listen()
    await watch.listen()
    heard = []
    subscriber = reem_async.CallbackSubscriber(name, binterface, lambda data, updated_path: heard.append(data))
    await subscriber.listen()
    await apspace[name].write({"t": 1.5, "rgb": before, "list": [Png(DEPTH)]})
    array = before.decode()
    update = await anext(watch)
    await aeventually(lambda: heard and mirror.value() is not None)
    for value in (await akvs[name].read(), kvs[name].read(), mirror.value(), update.data, update.value, heard[0]):
        assert np.array_equal(value["rgb"], array)
        assert np.array_equal(value["list"][0], DEPTH)
        assert value["t"] == 1.5
        assert not value["rgb"].flags.writeable
    for raw in (await akvs[name].read(raw=True), kvs[name].read(raw=True)):
        assert raw == {"t": 1.5, "rgb": before, "list": [Png(DEPTH)]}
    outline = await akvs[name]["rgb"].outline()
    assert (outline.kind, outline.size, outline.summary) == ("jpeg", len(before.data), before.summary)
    assert await akvs[name]["rgb"].type() is np.ndarray
    async with akvs[name].edit() as value:
        assert value["rgb"] == before
        value["t"] = 2.5
    assert await akvs[name].read(raw=True) == {"t": 2.5, "rgb": before, "list": [Png(DEPTH)]}
    await akvs[name]["rgb"].write(FRAME)
    assert np.array_equal(await akvs[name]["rgb"].read(raw=True), FRAME)
    for each in (watch, mirror, subscriber):
        await each.close()


async def test_a_picture_that_cannot_be_decoded_costs_nothing_beside_it(key, akvs, apspace, codec):
    """Without a decoder, and of a camera's damaged file: only that value, in reads and in updates."""
    name, good = key("cam"), Jpeg(FRAME)
    cut = Jpeg(good.data[:-99])
    watch = akvs[name].watch(reem_async.Every(100))
    await watch.listen()
    has_none = codec() == "none"
    for number, (picture, is_lost) in enumerate([(cut, True), (good, has_none), (cut, True), (good, has_none)]):
        await apspace[name].write({"n": number, "rgb": picture})
        update = await anext(watch)
        assert (update.data["n"], update.gap) == (number, False)
        assert (type(update.data["rgb"]) is Unreadable) is is_lost
        assert await akvs[name]["n"].read() == number
        assert (await akvs[name].read(raw=True))["rgb"] == picture
    if has_none:
        with pytest.raises(BadData, match=r"cam.rgb.*needs simplejpeg or Pillow"):
            await akvs[name].read()
    await watch.close()


async def test_a_recording_has_the_files_and_readers_arrays(key, raw, akvs, apspace, binterface, file):
    name, again = key("cam"), key("again")
    pictures = [Jpeg(FRAME), Jpeg(LARGE), Jpeg(FRAME[:20])]  # their size changes
    await apspace[name].write({"rgb": Jpeg(FRAME, 50), "mask": Png(DEPTH)})
    async with Recorder(binterface, [name], file) as recorder:
        for number, picture in enumerate(pictures):
            await apspace[name]["rgb"].write(picture)
            await aeventually(lambda n=number: recorder.status.messages > n + 3)
        await akvs[name]["mask"].write(Png(DEPTH + 1))  # only stored
        await aeventually(lambda: recorder.status.messages > 6)
    with open_log(file) as log:
        found = {each.schema for each in log.channels() if each.role in ("update", "part") and each.path != name}
        assert found == {"foxglove.CompressedImage", f"reem.{name}.mask"}  # the latter says what was only stored
        assert [it for _, it in log.raw[name]["rgb"].values()] == [Jpeg(FRAME, 50), *pictures]
        arrays = log[name]["rgb"].history()[1]
        assert [it.shape for it in arrays] == [FRAME.shape, FRAME.shape, LARGE.shape, FRAME[:20].shape]
        assert np.array_equal(log[name].at(log.end)["mask"], DEPTH + 1)
        handle = log.tree_at(log.end)[name]["rgb"]
        assert (handle.label, handle.dtype, handle.shape) == ("jpeg", "uint8", FRAME[:20].shape)
        assert np.array_equal(handle.read(), pictures[-1].decode())
        await Replayer(binterface, log, rate=100, remap={name: again}).play()
        assert await akvs[again].read(raw=True) == {"rgb": pictures[-1], "mask": Png(DEPTH + 1)}
    assert_no_orphans(raw, name)


def test_the_page_shows_the_file_of_a_jpeg_and_the_numbers_of_a_png(server_url, key, pspace):
    name = key("cam")
    with served(live(server_url)) as (address, _), client_of(address) as ask:
        pspace[name] = {"rgb": Jpeg(FRAME), "mask": Png(DEPTH)}
        assert {it["kind"] for it in ask.rows(name).values()} == {"jpeg", "png"}
        assert ask.ask("picture", path=f"{name}.rgb").content == Jpeg(FRAME).data
        assert ask.json("array", path=f"{name}.mask")["dtype"] == "uint16"
        assert ask.json("table", path=f"{name}.mask")["cells"][1][1] == str(DEPTH[1, 1])


def test_both_fronts_have_the_same_classes():
    assert reem.Jpeg is Jpeg
    assert reem.Png is Png
    assert reem.JpegShip is reem_async.JpegShip
