"""Files that get their name once they are whole: beside other programs, on odd file systems, in shared directories."""

import contextlib
import errno
import fcntl
import os
import stat
import threading

import pytest

from reem_async.errors import BadValue
from reem_async.tools.partfile import PartFile
from reem_async.tools.recording.output import Output


def written(target, content, **options):
    part = PartFile(target, **options)
    os.write(part.descriptor, content)
    part.finish()


def content(directory):
    return {path.name: path.read_bytes() for path in directory.iterdir()}


# --- a name that somebody else takes meanwhile -------------------------------------------------


def refused(*_, **__):
    raise OSError(errno.EPERM, os.strerror(errno.EPERM))


@pytest.fixture(params=["hard links", "none"])
def links(request, monkeypatch):
    if request.param == "none":
        monkeypatch.setattr(os, "link", refused)


@pytest.mark.usefixtures("links")
def test_what_came_to_be_meanwhile_is_not_replaced(tmp_path):
    """A look at the beginning does not help: two snapshots of the same second were both saved, and one was lost."""
    file = tmp_path / "a.zip"
    first, second = PartFile(file), PartFile(file)
    os.write(first.descriptor, b"first")
    first.finish()
    with pytest.raises(FileExistsError, match=r"a\.zip is there already; .*overwrite=True"):
        second.finish()
    assert first.path == file
    second.close()
    assert content(tmp_path) == {"a.zip": b"first"}
    written(file, b"third", replace=True)
    assert content(tmp_path) == {"a.zip": b"third"}


def test_a_hidden_name_that_is_left_of_a_whole_file_goes_and_the_file_stays(tmp_path):
    """The program was killed after the file had got its name and before the hidden one was gone."""
    file, hidden = tmp_path / "a", tmp_path / ".a.0123abcd.reem.part"
    file.write_bytes(b"whole")
    hidden.hardlink_to(file)
    PartFile(tmp_path / "b").close()
    assert content(tmp_path) == {"a": b"whole"}


def test_who_cannot_remove_the_hidden_name_has_the_file(tmp_path, monkeypatch):
    with monkeypatch.context() as patched:
        patched.setattr(os, "unlink", refused)
        written(tmp_path / "a", b"whole")
    assert sorted(content(tmp_path).values()) == [b"whole"] * 2
    written(tmp_path / "b", b"b")
    assert content(tmp_path) == {"a": b"whole", "b": b"b"}


def test_what_is_no_file_is_not_replaced(tmp_path):
    os.mkfifo(tmp_path / "pipe")
    with pytest.raises(OSError, match="not a file"):
        PartFile(tmp_path / "pipe", replace=True)
    assert [path.name for path in tmp_path.iterdir()] == ["pipe"]


# --- file systems that have other locks, or none -------------------------------------------------

flock = fcntl.flock


def of_nfs(descriptor, operation):
    """A lock that keeps others out needs a file that is open for writing."""
    reading = fcntl.fcntl(descriptor, fcntl.F_GETFL) & os.O_ACCMODE == os.O_RDONLY
    if operation & fcntl.LOCK_EX and reading:
        raise OSError(errno.EBADF, os.strerror(errno.EBADF))
    flock(descriptor, operation)


def of_cifs(descriptor, operation):
    """What is locked has an error of its own."""
    try:
        flock(descriptor, operation)
    except BlockingIOError:
        raise PermissionError(errno.EACCES, os.strerror(errno.EACCES)) from None


def of_none(descriptor, operation):
    raise OSError(errno.EOPNOTSUPP, os.strerror(errno.EOPNOTSUPP))


@pytest.fixture(params=[of_nfs, of_cifs, of_none])
def locks(request, monkeypatch):
    monkeypatch.setattr(fcntl, "flock", request.param)
    return request.param is not of_none


def test_the_hidden_file_of_a_program_at_work_is_not_deleted_by_the_next_one(tmp_path, locks):
    at_work = PartFile(tmp_path / "one.zip")
    os.write(at_work.descriptor, b"whole")
    (tmp_path / ".dead.zip.0123abcd.reem.part").write_bytes(b"half")
    (tmp_path / ".c.zip.0123abcd.part").write_bytes(b"foreign")
    if not locks:  # then it is old that tells it
        os.utime(tmp_path / ".dead.zip.0123abcd.reem.part", (1, 1))
    written(tmp_path / "two.zip", b"two")
    at_work.finish()
    assert content(tmp_path) == {"one.zip": b"whole", "two.zip": b"two", ".c.zip.0123abcd.part": b"foreign"}


def test_a_recording_that_is_running_is_not_replaced(tmp_path, locks):
    """Where there are no locks, one that was written to a moment ago is running."""
    file = tmp_path / "run.mcap"
    running = Output(file, overwrite=False)
    running.write(b"a")
    running.flush()
    with pytest.raises(BadValue, match="is being recorded by another recorder"):
        Output(file, overwrite=True)
    running.close()
    if not locks:
        os.utime(file, (1, 1))
    later = Output(file, overwrite=True)
    later.write(b"b")
    later.flush()
    later.appear()
    later.close()
    assert content(tmp_path) == {"run.mcap": b"b"}


# --- directories in which anybody may make files -------------------------------------------------


def test_what_is_no_file_holds_nobody_up(tmp_path):
    """A FIFO was opened, which waits for whoever writes to it."""
    fifo, link, target = tmp_path / ".a.00000000.reem.part", tmp_path / ".b.00000000.reem.part", tmp_path / "other"
    os.mkfifo(fifo)
    target.write_bytes(b"other")
    link.symlink_to(target)
    work = threading.Thread(target=written, args=(tmp_path / "c", b"whole"), daemon=True)
    work.start()
    work.join(10)
    waits = work.is_alive()
    with contextlib.suppress(OSError):
        os.close(os.open(fifo, os.O_WRONLY | os.O_NONBLOCK))  # lets it go on
    assert not waits
    assert sorted(path.name for path in tmp_path.iterdir()) == sorted([fifo.name, link.name, "other", "c"])


# --- who may read it -------------------------------------------------


@pytest.fixture
def umask():
    old = os.umask(0o022)
    yield
    os.umask(old)


def mode(path):
    return oct(stat.S_IMODE(path.stat().st_mode))


@pytest.mark.usefixtures("umask")
@pytest.mark.parametrize("given", [0o600, 0o640, 0o666])
def test_what_replaces_a_private_file_is_private_from_the_beginning(tmp_path, given):
    file = tmp_path / "a"
    written(file, b"old")
    assert mode(file) == "0o644"
    file.chmod(given)
    part = PartFile(file, replace=True)
    assert mode(part.path) == oct(given)
    part.finish()
    assert mode(file) == oct(given)


@pytest.mark.usefixtures("umask")
def test_a_group_that_cannot_be_kept_does_not_become_another_one(tmp_path, monkeypatch):
    file = tmp_path / "a"
    file.write_bytes(b"old")
    file.chmod(0o664)
    others = next(group for group in (*os.getgroups(), 12345) if group != os.getegid())
    try:
        os.chown(file, -1, others)
    except PermissionError:
        pytest.skip("this user has no second group")
    monkeypatch.setattr(os, "fchown", refused)
    written(file, b"new", replace=True)
    assert mode(file) == "0o604"


# --- names -------------------------------------------------


@pytest.mark.parametrize(
    "name",
    ["ä" * 120 + ".zip", "x" * 251 + ".zip", "é🤖" * 40, "a\nb", os.fsdecode(b"\xff" * 250)],
    ids=["two bytes", "one byte", "several bytes", "two lines", "no text"],
)
def test_a_name_as_long_as_the_file_system_takes(tmp_path, name):
    """Its limit is of bytes, and the hidden name is of these and more."""
    (tmp_path / f".{name[:20]}.0123abcd.reem.part").write_bytes(b"half")
    written(tmp_path / name, b"whole")
    assert content(tmp_path) == {name: b"whole"}
