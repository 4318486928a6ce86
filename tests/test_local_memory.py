"""Slots of shared memory: what must hold whatever comes between any two steps, and whatever a notice names."""

import errno
import fcntl
import gc
import mmap
import os
import signal
import socket
import stat
from pathlib import Path

import numpy as np
import orjson
import pytest
from slotkit import at_step

import reem_async.local as local_path
from reem_async.local import LocalPath
from reem_async.local import segment as local_segment
from reem_async.local.segment import (
    HEAD,
    IDENTITY,
    MARK,
    SEALS,
    SLOTS,
    STAMP,
    LocalReader,
    Segment,
    host,
    reason_against,
    stamp_at,
)
from reem_async.plan.changes import EncodedAttachment
from reem_async.plan.keys import keys_of
from reem_async.plan.notices import ANNOUNCED, LARGEST_INLINE, Slot, announce, decode, in_slot
from reem_async.plan.placeholders import Placeholder
from reem_async.ships.registry import Ships, default_ships
from reem_async.transport.protocol import CommandRecorder

pytestmark = pytest.mark.skipif(bool(reason_against()), reason=f"no shared memory: {reason_against()}")

KEYS = keys_of("k")


def put(segment, data, pieces=None):
    number, stamp = segment.put(pieces or [data], [len(data)])
    return Slot(host(), os.getpid(), segment.descriptor, segment.inode, number, stamp)


def descriptors():
    gc.collect()
    return len(os.listdir("/proc/self/fd"))


@pytest.fixture
def uncollected():
    gc.collect()
    gc.disable()
    yield
    gc.enable()


def interrupt():
    raise KeyboardInterrupt


def check_all_slots(segment):
    readers = [LocalReader() for _ in range(SLOTS)]
    views = [reader.view(put(segment, b"%d" % number), 1) for number, reader in enumerate(readers)]
    assert [bytes(view) for view in views] == [b"%d" % number for number in range(SLOTS)]
    assert segment.put([b"x"], [1]) is None


# --- what goes wrong on the way


@pytest.mark.parametrize(
    "step", ["lock_for_writing", "os.memfd_create", "os.posix_fallocate", "fcntl.fcntl", "mmap.mmap"]
)
def test_whatever_keeps_a_slot_from_being_written_leaves_the_update_to_the_server(monkeypatch, step):
    def refused(*_):
        raise OSError(errno.ENOMEM, "cannot allocate memory")

    path = LocalPath()
    with monkeypatch.context() as patched:
        patched.setattr(f"reem_async.local.segment.{step}", refused)
        assert path.put(KEYS, [b"x"], [1]) is None
    assert path.put(KEYS, [b"x"], [1]) is not None


def test_a_slot_that_cannot_be_mapped_is_left_to_the_server(monkeypatch):
    def refused(*_, **__):
        raise OSError(errno.ENOMEM, "cannot allocate memory")

    segment = Segment(1000)
    slot = put(segment, b"x")
    with monkeypatch.context() as patched:
        patched.setattr("reem_async.local.segment.mmap.mmap", refused)
        assert LocalReader().view(slot, 1) is None
    assert bytes(LocalReader().view(slot, 1)) == b"x"


def test_a_buffer_of_more_bytes_than_it_says_does_not_reach_the_next_slot():
    path = LocalPath()
    first = path.put(KEYS, [b"x"], [1])
    view = path.view(first, 1)
    for _ in range(SLOTS):
        assert path.put(KEYS, [memoryview(bytes(1 << 14)).cast("H")], [1 << 13]) is None
    assert bytes(view) == b"x"


def test_a_value_beyond_the_limit_leaves_smaller_ones_their_memory():
    path = LocalPath(memory=1 << 20)
    small = path.put(KEYS, [b"x"], [1])
    assert path.put(KEYS, [bytes(1 << 20)], [1 << 20]) is None
    assert path.put(KEYS, [b"x"], [1]).inode == small.inode


def test_a_program_that_may_not_look_at_its_host_any_more_goes_through_the_server(monkeypatch):
    def gone(_):
        raise FileNotFoundError

    monkeypatch.setattr(local_segment, "_named", gone)
    assert host() == ""


def test_what_was_short_for_a_moment_is_tried_again(monkeypatch):
    local_segment._found_against.cache_clear()

    def full(_):
        raise OSError(errno.EMFILE, "too many open files")

    with monkeypatch.context() as patched:
        patched.setattr(local_segment, "Segment", full)
        assert "too many open files" in reason_against()
    assert reason_against() == ""


# --- between any two steps


def test_a_call_that_is_refused_a_slot_leaves_it_to_who_has_it():
    segment, late = Segment(1000), []

    class Buffers:
        def __iter__(self):
            late.extend(put(segment, b"x" * 6).number for _ in range(3 * SLOTS))
            return iter([b"outer!"])

    number, _ = segment.put(Buffers(), [6])
    assert number not in late


@pytest.mark.usefixtures("uncollected")
@pytest.mark.filterwarnings("ignore:unclosed file:ResourceWarning")
def test_an_interrupt_in_the_middle_of_writing_leaves_every_slot_free_and_none_torn():
    segment, place, reached = Segment(1000), 0, True
    while reached:
        place += 1
        before = [put(segment, b"before") for _ in range(SLOTS)]
        try:
            reached = at_step(place, interrupt, lambda: segment.put([b"one", b"two"], [6]))
        except KeyboardInterrupt:
            assert all(LocalReader().view(slot, 6) in (None, b"before") for slot in before)
    assert place > 50
    check_all_slots(segment)


def test_a_child_forked_in_the_middle_of_writing_leaves_the_slot_to_its_readers():
    segment, children = Segment(1000), []

    class Buffers:
        def __iter__(self):
            children.append(os.fork())
            if not children[-1]:
                signal.pause()
            return iter([b"x" * 6])

    try:
        assert bytes(LocalReader().view(put(segment, b"x" * 6, Buffers()), 6)) == b"x" * 6
    finally:
        os.kill(children[0], signal.SIGKILL)
        os.waitpid(children[0], 0)


@pytest.mark.usefixtures("uncollected")
@pytest.mark.filterwarnings("ignore:unclosed file:ResourceWarning")
def test_an_interrupt_in_the_middle_of_reading_leaves_no_lock_and_no_descriptor():
    segment, reader, place, reached = Segment(1000), LocalReader(), 0, True
    slot = put(segment, b"what is read")
    assert bytes(reader.view(slot, 12)) == b"what is read"
    before = descriptors()
    while reached:
        place += 1
        try:
            reached = at_step(place, interrupt, lambda: reader.view(slot, 12))
        except KeyboardInterrupt:
            continue
    assert place > 50
    assert descriptors() == before
    reader.close()
    check_all_slots(segment)


def test_a_view_outlives_its_reader_and_its_publisher():
    before = descriptors()
    segment, reader = Segment(1000), LocalReader()
    view = reader.view(put(segment, b"what is read"), 12)
    array = np.frombuffer(view, np.uint8)[::2]
    reader.close()
    del segment, reader, view
    gc.collect()
    assert bytes(array) == b"what is read"[::2]
    del array
    assert descriptors() == before


def test_a_segment_whose_views_are_kept_is_not_forgotten_and_its_views_stay_counted(monkeypatch):
    """Else one slow reader would take a few slots more each time, and in the end all."""
    segment, reader = Segment(1000), LocalReader()
    monkeypatch.setattr(local_segment, "_IDLE", -1.0)
    views = []
    for number in range(SLOTS + 2):
        views.append(reader.view(put(segment, b"%d" % number), 1))
        reader.let_go()
    assert [bytes(view) for view in views] == [b"%d" % number for number in range(SLOTS + 2)]
    views.clear()
    reader.let_go()
    assert not reader._mappings


# --- what an interface has


def frames(local, *sizes):
    """Put one value of each size; which segment each is in, None where there was none."""
    return [slot and slot.inode for slot in (local.put(KEYS, [b"x" * size], [size]) for size in sizes)]


def test_a_value_that_grows_with_each_update_takes_few_segments():
    """Readers keep the old ones for some seconds: one for each update would fill the memory of the machine."""
    found = frames(LocalPath(), *range(70_000, 1_400_000, 7_000))
    assert None not in found
    assert len(set(found)) <= 6


def test_growing_stays_below_the_share_of_memory():
    local = LocalPath(memory=10_000_000)
    found = frames(local, 800_000, 900_000, 1_000_000, 1_500_000, 1_700_000, 800_000)
    assert [each is not None for each in found] == [True, True, True, True, False, True]
    assert sum(segment.shape.size for segment in local._segments.values()) <= 10_000_000


def test_an_idle_segment_is_given_up(monkeypatch):
    local, before = LocalPath(), descriptors()
    frames(local, 100_000)
    other = keys_of("other")
    local.answered(other, 1)
    assert len(local._segments) == 1
    monkeypatch.setattr(local_path, "_IDLE", -1.0)
    local.answered(other, 1)
    assert not local._segments
    assert descriptors() == before


def test_without_descriptors_there_is_no_slot_and_no_view_and_nothing_is_raised():
    local, segment, reader = LocalPath(), Segment(1000), LocalReader()
    local.put(keys_of("first"), [b"x" * 100_000], [100_000])  # what is imported is
    slot = put(segment, b"x")
    before, taken = descriptors(), []
    try:
        while True:
            taken.append(os.open("/dev/null", os.O_RDONLY))
            if len(taken) > 100_000:
                pytest.skip("there is no limit")
    except OSError:
        pass
    try:
        assert local.put(KEYS, [b"x" * 100_000], [100_000]) is None
        assert reader.view(slot, 1) is None
    finally:
        for each in taken:
            os.close(each)
    assert descriptors() == before
    assert local.put(KEYS, [b"x" * 100_000], [100_000]) is not None
    assert bytes(reader.view(slot, 1)) == b"x"


# --- what a notice names


def sealed(content, name="reem", seals=SEALS, size=None, sparse=False):
    """A file in memory as somebody may make it; all its memory is taken, unless it is sparse."""
    descriptor = os.memfd_create(name, os.MFD_CLOEXEC | os.MFD_ALLOW_SEALING)
    os.write(descriptor, content)
    if size is not None:
        os.ftruncate(descriptor, size)
        if not sparse:
            os.posix_fallocate(descriptor, 0, size)
    fcntl.fcntl(descriptor, fcntl.F_ADD_SEALS, seals)
    return descriptor


def identity(slots, room, stamp=7):
    return (IDENTITY.pack(MARK, slots, room).ljust(stamp_at(0), b"\0") + STAMP.pack(stamp) * 8).ljust(HEAD, b"\0")


def fifo(folder):
    os.mkfifo(folder / "fifo")
    return os.open(folder / "fifo", os.O_RDWR)


def named(kind):
    """A file of this kind with the name of REEM's memory: in the root folder, and deleted."""
    path = Path("/memfd:reem")
    try:
        os.mknod(path, kind | 0o600, os.makedev(1, 5))
        return os.open(path, os.O_PATH)
    except PermissionError:
        pytest.skip("only root can make it")
    finally:
        path.unlink(missing_ok=True)


OPENED = {
    "fifo": fifo,
    "device": lambda _: os.open("/dev/zero", os.O_RDONLY),
    "terminal": lambda _: os.openpty()[0],
    "directory": lambda folder: os.open(folder, os.O_RDONLY),
    "file": lambda folder: os.open(folder / "file", os.O_RDWR | os.O_CREAT),
    "socket": lambda _: socket.socket(socket.AF_UNIX).detach(),
    "pipe": lambda _: os.pipe()[0],
    "fifo of that name": lambda _: named(stat.S_IFIFO),
    "device of that name": lambda _: named(stat.S_IFCHR),
    "file of that name": lambda _: named(stat.S_IFREG),
    "another name": lambda _: sealed(identity(1, 4096), "other", size=2 * HEAD),
    "nothing in it": lambda _: sealed(b""),
    "not sealed": lambda _: sealed(identity(1, 4096), seals=0, size=2 * HEAD),
    "could shrink": lambda _: sealed(identity(1, 4096), seals=SEALS & ~fcntl.F_SEAL_SHRINK, size=2 * HEAD),
    "another mark": lambda _: sealed(b"x" * 2 * HEAD),
    "too short": lambda _: sealed(identity(6, 4096), size=2 * HEAD),
    "too long": lambda _: sealed(identity(1, 4096), size=3 * HEAD),
    "no slots": lambda _: sealed(identity(0, 4096), size=HEAD),
    "too many slots": lambda _: sealed(identity(1 << 20, 0), size=HEAD),
    "no room": lambda _: sealed(identity(2, 0), size=HEAD),
    "too much room": lambda _: sealed(identity(1, (1 << 64) - 1), size=HEAD),
    "of 100 GB": lambda _: sealed(identity(1, 100 << 30), size=HEAD + (100 << 30), sparse=True),
    "of 1 GB that are not there": lambda _: sealed(identity(1, 1 << 30), size=HEAD + (1 << 30), sparse=True),
    "another stamp": lambda _: sealed(identity(1, 4096, stamp=8), size=2 * HEAD),
}


def test_what_somebody_else_makes_as_a_publisher_does_is_a_segment():
    """So that below it is what is named that decides."""
    descriptor = sealed(identity(1, 4096), size=2 * HEAD)
    try:
        slot = Slot(host(), os.getpid(), descriptor, os.fstat(descriptor).st_ino, 0, 7)
        assert bytes(LocalReader().view(slot, 1)) == b"\0"
    finally:
        os.close(descriptor)


@pytest.mark.parametrize("what", OPENED)
def test_what_is_no_segment_is_not_looked_into(what, tmp_path):
    before, descriptor = descriptors(), OPENED[what](tmp_path)
    own = descriptors()
    try:
        slot = Slot(host(), os.getpid(), descriptor, os.fstat(descriptor).st_ino, 0, 7)
        reader = LocalReader()
        assert reader.view(slot, 1) is None
        assert reader.view(slot._replace(inode=slot.inode + 1), 1) is None
        reader.close()
        assert descriptors() == own
    finally:
        os.close(descriptor)
    assert own > before or what == "terminal"


WRONG = {
    "process": [0, 1, 2**22, 2**31, 2**52, -1],
    "descriptor": [0, 1, 2, 10**6, 2**31, 2**52, -1],
    "inode": [0, 1, 2**52],
    "number": [SLOTS - 1, SLOTS, 2**31, 2**52, -1],
    "stamp": [0, 1, 2**52, -1],
}


@pytest.mark.parametrize("field", WRONG)
def test_a_slot_that_is_somewhere_else_is_not_there(field):
    segment, reader = Segment(1000), LocalReader()
    slot = put(segment, b"what is read")
    for wrong in WRONG[field]:
        assert reader.view(slot._replace(**{field: wrong}), 12) is None
    assert bytes(reader.view(slot, 12)) == b"what is read"


def test_sizes_beyond_the_slot_are_not_there():
    segment, reader = Segment(1000), LocalReader()
    slot = put(segment, b"what is read")
    for size in (mmap.PAGESIZE + 1, 2**31, 2**52, 2**64, 0, -1):
        assert reader.view(slot, size) is None
    assert len(reader.view(slot, mmap.PAGESIZE)) == mmap.PAGESIZE


def test_a_slot_of_another_host_is_not_looked_for():
    local, segment = LocalPath(), Segment(1000)
    slot = put(segment, b"x")
    assert local.view(slot._replace(host="0123456789abcdef"), 1) is None
    assert bytes(local.view(slot, 1)) == b"x"


ARRAY = np.arange(1000, dtype=np.float64)
SHIPS = Ships(default_ships(), CommandRecorder)


def attachment(label="numpy", suffix=".a", pieces=None):
    pieces = SHIPS.labelled("numpy", "").ship.pack(ARRAY) if pieces is None else pieces
    return EncodedAttachment(suffix, label, (), pieces)


@pytest.fixture
def local():
    local = LocalPath()
    yield local
    local.close()


def shared(local):
    """A notice of {"a": ARRAY} that is in a slot, as its fields."""
    text, it = orjson.dumps({"a": str(Placeholder("numpy", ".a", ARRAY.nbytes))}), attachment()
    sizes = [len(text), sum(len(piece) for piece in it.blob)]
    slot = local.put(KEYS, [text, *it.blob], sizes)
    return orjson.loads(in_slot("p", 1, 1.0, ("x",), slot, text, [it]))


def heard(local, fields):
    return decode(orjson.dumps(fields) + b"\n", SHIPS, local.view)


def test_a_notice_as_it_is_has_the_value(local):
    notice = heard(local, shared(local))
    assert np.array_equal(notice.value["a"], ARRAY)
    assert not notice.value["a"].flags.writeable


def spoiled(parts):
    """What a stranger may make of the parts of a notice: (where the text is, each attachment)."""
    (text, part) = parts
    numbers = (0, 1, len(text), 63, 64, 4096, 2**31, 2**52, 2**53, 2**64, -1, 1.5, True, None, "8", [], {})
    for wrong in numbers:
        if wrong != text[-1] or type(wrong) is bool:
            yield [[*text[:-1], wrong], part]
        if wrong != part[-1] or type(wrong) is bool:
            yield [text, [*part[:-1], wrong]]
    yield [text]
    yield [part, text]
    yield [text, part, part]
    yield [text, *[part] * 1000]
    yield [text, ["numpy", ".b", part[2]]]
    for wrong in ("bytes", "nobody", "", 1, None, [], {}):
        yield [text, [wrong, *part[1:]]]
    for wrong in (1, None, [], {}):
        yield [text, [part[0], wrong, part[2]]]
    for wrong in ([], [1], [text, text], "x", {}, None, 1, [*text, 1], text[:-1]):
        yield [wrong, part]


def test_parts_that_a_slot_cannot_have_are_not_looked_at(local):
    fields = shared(local)
    for parts in spoiled(fields[-1]):
        if any(type(part) is int and part > 2**63 for each in parts if isinstance(each, list) for part in each):
            continue  # no JSON of ours has it
        notice = heard(local, [*fields[:-1], parts])
        assert notice.value is ANNOUNCED, parts
    assert np.array_equal(heard(local, fields).value["a"], ARRAY)


def test_a_notice_of_thousands_of_arrays_names_no_slot():
    """Else subscribers would take it for a stranger's: it is longer than any of REEM's."""
    many = [attachment(suffix=f".{number:06}", pieces=(b"x" * 20,)) for number in range(10_000)]
    payload = in_slot("p", 1, 1.0, (), Slot("h", 1, 2, 3, 4, 5), b"{}", many)
    assert len(payload) <= LARGEST_INLINE
    notice = decode(payload, SHIPS)
    assert (notice.slot, notice.value, notice.size) == (None, ANNOUNCED, 200_002)
    assert payload == announce("p", 1, 1.0, (), size=200_002)


def test_pieces_without_bytes_are_passed_over():
    segment = Segment(1000)
    number, stamp = segment.put([b"", b"ab", b"", memoryview(b""), b"cd", b""], [0, 4, 0])
    slot = Slot("", os.getpid(), segment.descriptor, segment.inode, number, stamp)
    assert bytes(LocalReader().view(slot, 4)) == b"abcd"
