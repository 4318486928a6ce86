"""The file of a portable snapshot: whole or refused, under its name or not there at all."""

import asyncio
import contextlib
import io
import json
import random
import zipfile

import numpy as np
import pytest
import snapshotkit
from conftest import assert_same, commands_run, python
from snapshotkit import everything, left_in

import reem_async
import reem_async.snapshots
from reem_async.errors import BadData
from reem_async.tools.cli.snapshot import prune
from reem_async.tools.snapshots import describe, described, restore, save
from reem_async.tools.snapshots.archive import Archive, ArchiveWriter, header
from reem_async.tools.snapshots.files import new_name
from reem_async.tools.snapshots.plans import KeyContent, Value, joined, split

servers, raws, here, there = snapshotkit.servers, snapshotkit.raws, snapshotkit.here, snapshotkit.there


# --- the file -------------------------------------------------


async def test_any_unzip_opens_it(here, raws, tmp_path):
    array = np.arange(6).reshape(2, 3)
    await reem_async.KeyValueStore(here)["foo"].write({"x": array, "b": b"bytes"})
    await save(here, tmp_path / "a.zip")
    with zipfile.ZipFile(tmp_path / "a.zip") as archive:
        assert archive.testzip() is None
        first, *names = archive.namelist()
        assert first == "reem-snapshot.json"
        facts = json.loads(archive.read(first))
        assert (facts["format"], facts["version"], facts["match"]) == ("reem-snapshot", 1, "*")
        assert json.loads(archive.read("keys/1/document.json"))["x"].startswith("$ship numpy .x")
        arrays = [np.load(io.BytesIO(archive.read(name))) for name in names if name.endswith(".npy")]
        assert_same(arrays, [array])


async def test_a_damaged_file_is_refused_and_nothing_restored(here, there, raws, tmp_path):
    await reem_async.KeyValueStore(here)["foo"].write({"x": np.arange(500), "y": [b"bytes" * 50], "z": "text" * 50})
    await reem_async.KeyValueStore(here)["bar"].write([1, 2, 3])
    await save(here, tmp_path / "a.zip")
    whole = (tmp_path / "a.zip").read_bytes()
    before = commands_run(raws[1]).get("json.set")
    bad = tmp_path / "bad.zip"
    places = [len(whole) * part // 50 for part in range(50)] + [1, 29, 40, len(whole) - 1, len(whole) - 70]
    for place in places:
        changed = bytearray(whole)
        changed[place] ^= 0x10
        for content in (bytes(changed), whole[:place]):
            bad.write_bytes(content)
            with pytest.raises(BadData, match=r"bad\.zip"):
                await restore(there, bad, replace=True)
            with contextlib.suppress(BadData):  # looks at a part only; anything else would be a crash
                await describe(bad)
    bad.write_bytes(whole + b"\0")
    with pytest.raises(BadData):
        await restore(there, bad)
    assert everything(raws[1]) == {}
    assert commands_run(raws[1]).get("json.set") == before
    bad.write_bytes(whole)
    await restore(there, bad)


@pytest.mark.parametrize(
    "content",
    [b"", b"PK\3\4", b"some text", b"PK\5\6" + bytes(18), b"REDIS", b"PK\3\4" + bytes(26) + b"reem-snapshot.json"],
)
async def test_other_files_are_refused(there, raws, tmp_path, content):
    (tmp_path / "x.zip").write_bytes(content)
    for call in (restore(there, tmp_path / "x.zip"), describe(tmp_path / "x.zip")):
        with pytest.raises(BadData, match=r"x\.zip"):
            await call


def written(path, *entries, **facts):
    writer = ArchiveWriter(path, {**header("here", "", "*", "1"), **facts})
    for entry in entries:
        writer.add(entry)
    writer.finish({})
    return path


def test_what_a_newer_program_wrote_is_refused(tmp_path):
    with pytest.raises(BadData, match="version 2"):
        Archive(written(tmp_path / "a.zip", version=2))


@pytest.mark.parametrize(
    "entry",
    [
        KeyContent("foo", b"1", (), (Value(":ships", "string", (b"x",)),)),
        KeyContent("foo", b"1", (":last",), ()),
        KeyContent("foo", b"1", (".a[",), ()),
        KeyContent("foo}", b"1", (), ()),
        KeyContent("", b"1", (), ()),
        KeyContent("foo", b"1", (), (Value(".x", "stream", (b"x",)),)),
    ],
)
def test_an_index_is_not_trusted(tmp_path, entry):
    with pytest.raises(BadData, match=r"a\.zip"):
        Archive(written(tmp_path / "a.zip", entry))


async def test_a_document_that_is_none_stops_before_anything_of_it_is_written(there, raws, tmp_path):
    path = written(tmp_path / "a.zip", KeyContent("foo", b'{"x":', (".x",), (Value(".x", "string", (b"1",)),)))
    with pytest.raises(BadData, match="JSON"):
        await restore(there, path)
    assert everything(raws[1]) == {}


def test_values_in_parts():
    dice = random.Random(1)
    for _ in range(300):
        pieces = [
            dice.choice([b"", b":", b"3:abc", dice.randbytes(dice.randrange(40))]) for _ in range(dice.randrange(9))
        ]
        blob = joined(pieces)
        assert split(blob) == pieces
        for place in {0, len(blob) // 2, len(blob) - 1} if blob else ():
            with contextlib.suppress(BadData):
                assert split(blob[:place]) != pieces
    for bad in (b"3:ab", b":", b"x:1", b"-1:", b"99999999999999999999:", b"1"):
        with pytest.raises(BadData):
            split(bad)


async def test_a_file_that_is_there_is_not_overwritten_unasked(here, raws, tmp_path):
    (tmp_path / "a.zip").write_text("precious")
    with pytest.raises(FileExistsError, match="overwrite=True"):
        await save(here, tmp_path / "a.zip")
    with pytest.raises(IsADirectoryError):
        await save(here, tmp_path)
    with pytest.raises(NotADirectoryError, match="make it first"):
        await save(here, tmp_path / "no" / "a.zip")
    with pytest.raises(FileNotFoundError):
        await restore(here, tmp_path / "no.zip")
    assert (tmp_path / "a.zip").read_text() == "precious"
    await save(here, tmp_path / "a.zip", overwrite=True)
    assert (await describe(tmp_path / "a.zip")).count == 0


async def test_cancelled_or_failed_it_leaves_no_file(here, raws, tmp_path):
    kvs = reem_async.KeyValueStore(here)
    for number in range(30):
        await kvs[f"k{number:02}"].write(np.zeros(100_000))
    reached = asyncio.Event()

    def told(progress):
        if progress.done == 10:
            reached.set()

    task = asyncio.create_task(save(here, tmp_path / "a.zip", progress=told))
    await reached.wait()
    task.cancel()
    with pytest.raises(asyncio.CancelledError):
        await task

    def fail(progress):
        if progress.done == 10:
            raise ZeroDivisionError

    with pytest.raises(ZeroDivisionError):
        await save(here, tmp_path / "b.zip", progress=fail)
    assert left_in(tmp_path) == []


KILLED = """
import asyncio, os, signal, sys
import reem_async
from reem_async.snapshots import save

def told(progress):
    print(progress.done, flush=True)
    if progress.done == 20:
        signal.pause()

async def main():
    async with reem_async.RedisInterface(sys.argv[1]) as interface:
        await save(interface, sys.argv[2], progress=told)

asyncio.run(main())
"""


async def test_killed_it_leaves_nothing_under_the_name(servers, here, raws, tmp_path):
    kvs = reem_async.KeyValueStore(here)
    for number in range(30):
        await kvs[f"k{number:02}"].write(np.zeros(100_000))
    target = tmp_path / "reem-20260801T000000Z.zip"
    with python(KILLED, servers[0].url, target, start=True) as process:
        while (line := process.stdout.readline().strip()) != "20":
            assert line, process.stderr.read()
        process.kill()
        process.wait()
    (part,) = tmp_path.iterdir()
    assert part.name.startswith(".reem-20260801")
    assert part.stat().st_size > 5_000_000, "it was half way"
    with pytest.raises(BadData):
        await describe(part)
    (tmp_path / ".reem-other.txt").write_text("x")
    await save(here, target)
    assert left_in(tmp_path) == [".reem-other.txt", target.name]


def test_names_say_when_and_pruning_deletes_only_its_own(tmp_path):
    """The oldest, by when they were written; never the newest, nor files of other names, kinds or content."""
    entry = KeyContent("foo", b"1", (), ())
    first = new_name(tmp_path, "portable", 0.0, auto=True)
    assert first.name == "reem-auto-19700101T000000Z.zip"
    others = [
        written(tmp_path / "reem-20200101T000000Z.zip", entry),  # saved by hand
        written(tmp_path / "reem-auto-20200101T000000Z-copy.zip", entry),
        tmp_path / "reem-auto-20200102T000000Z.zip",  # not a snapshot
        tmp_path / "reem-auto-20200102T000000Z.rdb",  # another kind
        tmp_path / "reem-auto-20200103T000000Z.zip",  # a link
    ]
    others[2].write_text("precious")
    others[3].write_bytes(b"REDIS0011" + bytes(20))
    others[4].symlink_to(others[0])
    earlier = [written(tmp_path / f"reem-auto-2030010{day}T000000Z.zip", entry) for day in range(1, 5)]
    made = []
    for _ in range(4):  # the clock has lost its time: all are of 1970
        made.append(written(new_name(tmp_path, "portable", 0.0, auto=True), entry))
        prune(described(made[-1]), 3)
        made = made[-3:]
    assert [path.name for path in made] == [f"reem-auto-19700101T000000Z-{number}.zip" for number in (2, 3, 4)]
    assert left_in(tmp_path) == sorted(path.name for path in made + others)
    assert not any(path.exists() for path in earlier)
    assert prune(described(made[-1]), 1) == made[:2]
