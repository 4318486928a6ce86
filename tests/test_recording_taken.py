"""Files that others are at: recordings, snapshots and exports while they are being made."""

import contextlib
import errno
import fcntl
import gc
import os
import resource
import signal
import socket
import stat
import threading
import time

import pytest
from clikit import begins, is_recording, started
from conftest import aeventually, line_of

import reem.recording
import reem_async
from reem_async.errors import BadValue
from reem_async.recording import Recorder, RecordingFailed, open_log
from reem_async.tools.partfile import PartFile
from reem_async.tools.recording.output import Output


async def test_what_is_to_be_replaced_stays_until_the_new_one_has_begun(key, apspace, binterface, file):
    async with Recorder(binterface, [key("*")], file):
        await apspace[key("arm")].write({"joint": 1})
    old = file.read_bytes()
    nobody = reem_async.RedisInterface("redis://127.0.0.1:1")
    with pytest.raises(reem_async.NotConnected):
        await Recorder(nobody, path=file, overwrite=True).start()
    Recorder(binterface, [key("*")], file, overwrite=True)  # never begun
    gc.collect()
    assert [each.read_bytes() for each in file.parent.iterdir()] == [old]
    recorder = Recorder(binterface, [key("*")], file, overwrite=True)
    assert file.read_bytes() == old
    async with recorder:
        await aeventually(lambda: is_recording(file))
        await apspace[key("arm")].write({"joint": 2})
    assert list(file.parent.iterdir()) == [file]
    with open_log(file) as log:
        assert log[key("arm.joint")].at(log.end) == 2


def test_a_part_file_leaves_a_link_a_link(tmp_path):
    """Also one that leads nowhere yet: a snapshot or an export took the place of the link itself."""
    link = tmp_path / "newest"
    (tmp_path / "there").mkdir()
    link.symlink_to(tmp_path / "there" / "file")
    for content in (b"first", b"second"):
        part = PartFile(link, replace=True)
        assert part.path.parent == tmp_path / "there"
        part.path.write_bytes(content)
        part.finish()
        assert link.is_symlink()
        assert link.read_bytes() == content


async def test_what_is_being_recorded_is_not_replaced(key, apspace, binterface, file):
    file.write_bytes(b"old")
    late = Recorder(binterface, [key("*")], file, overwrite=True)  # before the other one has begun
    async with Recorder(binterface, [key("*")], file, overwrite=True):
        with pytest.raises(BadValue, match="is being recorded by another recorder"):
            Recorder(binterface, [key("*")], file, overwrite=True)
        with pytest.raises(BadValue, match="is being recorded by another recorder"):
            await late.start()
        await apspace[key("arm")].write(1)
    assert list(file.parent.iterdir()) == [file]
    with open_log(file) as log:
        assert log[key("arm")].at(log.end) == 1
    async with Recorder(binterface, [key("*")], file, overwrite=True):
        pass


def append(file):
    with file.open("ab") as stream:
        stream.write(b"x")


def replace(file):
    other = file.with_name("other")
    other.write_bytes(b"somebody else's")
    other.replace(file)


@pytest.mark.parametrize(
    ("harm", "said"),
    [
        (lambda file: os.truncate(file, 100), "cut short"),
        (append, "written to"),
        (os.unlink, "deleted or replaced"),
        (replace, "deleted or replaced"),
    ],
    ids=["truncated", "appended", "deleted", "replaced"],
)
async def test_a_file_of_somebody_else_s_ends_the_recording(key, apspace, binterface, file, harm, said):
    recorder = Recorder(binterface, [key("*")], file)
    await recorder.start()
    await apspace[key("arm")].write(1)
    await aeventually(lambda: is_recording(file))
    harm(file)
    left = file.read_bytes() if file.exists() else b""
    await apspace[key("arm")].write(2)
    with pytest.raises(RecordingFailed, match=said) as caught:
        await recorder.wait(10)
    with pytest.raises(RecordingFailed, match=said):
        await recorder.stop()
    assert "can be read" not in str(caught.value), "nobody knows that"
    assert (file.read_bytes() if file.exists() else b"") == left, "nor is it touched"


def test_another_error_has_a_note_of_it(key, interface, file):
    def work():
        with reem.recording.Recorder(interface, [key("*")], file):
            file.unlink()
            raise ZeroDivisionError

    with pytest.raises(ZeroDivisionError) as caught:
        work()
    assert "deleted" in caught.value.__notes__[0]


def test_the_command_exits_with_1(key, server_url, pspace, file):
    pspace[key("a")] = 1
    with started(server_url, file.parent, "record", key("*"), "-o", file) as process:
        begins(process)
        file.unlink()
        process.send_signal(signal.SIGTERM)
        _, errors = process.communicate(timeout=20)
    assert "deleted or replaced" in errors
    assert process.returncode == 1


def test_a_hangup_ends_a_recording_as_ctrl_c_does(key, server_url, pspace, file):
    """The terminal is closed: nobody reads what is said, but the index is written."""
    pspace[key("a")] = 1
    ours, its = os.openpty()
    heed = {"preexec_fn": lambda: signal.signal(signal.SIGHUP, signal.SIG_DFL)}  # though the tests may run under nohup
    with started(server_url, file.parent, "record", key("*"), "-o", file, stdout=its, stderr=its, **heed) as process:
        os.close(its)
        assert line_of(ours).startswith("recording into ")
        os.close(ours)
        for _ in range(3):  # one is of the kernel, another of the shell
            process.send_signal(signal.SIGHUP)
            time.sleep(0.02)
        process.wait(timeout=20)
    with open_log(file) as log:
        assert (log.indexed, log[key("a")].at(log.end)) == (True, 1)


def test_a_part_file_is_removed_only_if_nobody_has_it(tmp_path):
    part = PartFile(tmp_path / "a")
    PartFile(tmp_path / "a").close()
    assert list(tmp_path.iterdir()) == [part.path]
    os.write(part.descriptor, b"whole")
    part.finish()
    assert [each.read_bytes() for each in tmp_path.iterdir()] == [b"whole"]
    dropped = PartFile(tmp_path / "b")
    del dropped
    assert list(tmp_path.iterdir()) == [tmp_path / "a"]


def test_of_two_recorders_that_make_the_same_file_one_is_refused(file):
    first, second = (Output(file, overwrite=overwrite) for overwrite in (False, True))
    first.write(b"first")
    first.flush()
    first.appear()
    with pytest.raises(BadValue, match="is being recorded by another recorder"):
        second.appear()
    with pytest.raises(BadValue, match="there already"):
        Output(file, overwrite=False)
    second.close()
    first.write(b" of all")
    first.flush()
    first.close()
    assert file.read_bytes() == b"first of all"


def test_ctrl_c_before_it_has_begun_is_no_recording(file, tmp_path):
    """A server that does not answer keeps the recorder from beginning."""
    with socket.create_server(("127.0.0.1", 0)) as silent:
        url = f"redis://127.0.0.1:{silent.getsockname()[1]}"
        with started(url, tmp_path, "record", "-o", file, "--url", url) as process:
            silent.settimeout(30)
            with silent.accept()[0]:
                process.send_signal(signal.SIGINT)
                out, err = process.communicate(timeout=30)
    assert (process.returncode, out, err) == (130, "", "")
    assert not list(tmp_path.iterdir())


def test_what_a_full_disk_keeps_from_beginning_is_not_there(binterface, file):
    """An empty file was, and had to be deleted by hand before the next try."""
    soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (0, hard))
    try:
        with pytest.raises(RecordingFailed, match="File too large"):
            Recorder(binterface, path=file)
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))
    assert not file.exists()


# --- files that get their name once they are whole: beside other programs, on odd file systems, in shared directories


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
    dead = tmp_path / ".dead.zip.0123abcd.reem.part"
    dead.write_bytes(b"half")
    (tmp_path / ".c.zip.0123abcd.part").write_bytes(b"foreign")
    written(tmp_path / "two.zip", b"two")
    at_work.finish()
    left = {} if locks else {dead.name: b"half"}  # without locks nothing tells that its program is gone
    assert content(tmp_path) == {"one.zip": b"whole", "two.zip": b"two", ".c.zip.0123abcd.part": b"foreign", **left}
    running = Output(tmp_path / "run.mcap", overwrite=False)
    running.appear()
    if locks:
        with pytest.raises(BadValue, match="is being recorded by another recorder"):
            Output(tmp_path / "run.mcap", overwrite=True)
    running.close()
    later = Output(tmp_path / "run.mcap", overwrite=True)
    later.appear()
    later.close()


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
