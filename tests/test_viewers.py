"""`reem foxglove` and `reem rerun`: what their clients get equals what was published."""

import contextlib
import json
import re
import struct
import time

import numpy as np
import pytest
from clikit import said_until
from conftest import PATIENCE, eventually, sized

import reem as blocking
from reem_async.ships.images import Jpeg
from reem_async.ships.registry import Ships, default_ships
from reem_async.tools.recording.layout import decode, from_json
from reem_async.transport.protocol import CommandRecorder

SHIPS = Ships(default_ships(), CommandRecorder).raw


class Client:
    """A client of Foxglove's protocol: channels by topic, and what came on each that it has subscribed to."""

    def __init__(self, address):
        from websockets.sync.client import connect

        self._connect = connect(address, subprotocols=["foxglove.sdk.v1"], max_size=None, compression=None)
        self.channels, self.got, self.parameters, self.status, self.states = {}, {}, {}, [], []
        self.time, self.address = 0, address
        self._by_subscription = {}

    def __enter__(self):
        self.socket = self._connect.__enter__()
        return self

    def __exit__(self, *raised):
        self._connect.__exit__(*raised)

    def send(self, **message):
        self.socket.send(json.dumps(message))

    def subscribe(self, *topics):
        """Subscribe to topics, once they are offered."""
        self.until(lambda: set(topics) <= self.channels.keys())
        for topic in topics:
            self._subscribe(topic)

    def _subscribe(self, topic):
        number = len(self._by_subscription) + 1
        self._by_subscription[number] = self.channels[topic]
        self.got.setdefault(topic, [])
        time.sleep(0.2)  # foxglove-sdk 0.30 announces a channel a moment before it accepts subscriptions
        self.send(op="subscribe", subscriptions=[{"id": number, "channelId": self.channels[topic]["id"]}])

    def play(self, command, speed=1.0, seek=None):
        """Send a request of the playback controls, in the protocol's binary form."""
        head = struct.pack("<BBfB", 3, {"play": 0, "pause": 1}[command], speed, seek is not None)
        self.socket.send(head + struct.pack("<QI", seek or 0, 1) + b"r")

    def until(self, condition, seconds=PATIENCE):
        """Receive until a condition holds."""
        end = time.monotonic() + seconds
        while not condition():
            said = {topic: (len(got), str(got[-1:])[:200]) for topic, got in self.got.items()}
            assert time.monotonic() < end, (self.channels.keys(), self.status, said)
            with contextlib.suppress(TimeoutError):
                self._take(self.socket.recv(timeout=0.1))

    def _take(self, message):
        if isinstance(message, bytes):
            if message[0] == 1:
                number, at = struct.unpack("<IQ", message[1:13])
                channel = self._by_subscription[number]
                self.got[channel["topic"]].append((at, _value(channel, message[13:])))
            elif message[0] == 2:
                self.time = struct.unpack("<Q", message[1:9])[0]
            elif message[0] == 5:
                self.states.append(message)
            return
        said = json.loads(message)
        for channel in said.get("channels", ()):
            self.channels[channel["topic"]] = channel
            if channel["topic"] in self.got:  # it has a new schema: as Foxglove does
                self._subscribe(channel["topic"])
        if said["op"] == "parameterValues":
            self.parameters.update({each["name"]: each["value"] for each in said["parameters"]})
        elif said["op"] == "status":
            self.status.append(said["message"])

    def values(self, topic):
        return [value for _, value in self.got[topic]]


def _value(channel, data):
    """The value that was published: the inverse of what recordings are written with, which has tests of its own."""
    if channel["encoding"] == "json":
        return from_json(data, wrapped=False)
    label = "jpeg" if channel["schemaName"] == "foxglove.CompressedImage" else "numpy"
    value = decode(channel["schemaName"], "3", label, data, SHIPS)
    return np.squeeze(value) if isinstance(value, np.ndarray) else value


@pytest.fixture
def started(cli):
    """Starts `reem foxglove` and connects a client to it."""

    @contextlib.contextmanager
    def start(*arguments):
        pytest.importorskip("foxglove", reason="foxglove-sdk is not installed")
        with cli.running("foxglove", "--port", "0", *arguments) as process:
            address = re.search(r"ws://\S+", said_until(process, "  to stop"))[0]
            with Client(address) as client:
                yield process, client

    return start


@pytest.fixture
def space(cli):
    with blocking.RedisInterface(cli.url, namespace=cli.namespace) as interface:
        yield blocking.PublishSpace(interface)


def test_foxglove_gets_each_update_and_picture_as_it_was_published(cli, space, started):
    count = sized(200, 2000)
    picture = np.random.default_rng(0).integers(0, 255, (48, 64, 3), "u1")
    space["arm"] = {"q": [0.0] * 7, "n": -1}
    space["camera"] = {"image": picture, "exposure": 1.5}
    space["lens"] = {"rgb": Jpeg(picture)}
    with started() as (process, client):
        client.subscribe("/arm", "/camera/image", "/lens/rgb")
        client.until(lambda: all(client.got.values()))
        assert client.channels["/camera/image"]["schemaName"] == "foxglove.RawImage"
        assert client.channels["/lens/rgb"]["schemaName"] == "foxglove.CompressedImage"
        np.testing.assert_array_equal(client.values("/camera/image")[-1], picture)
        assert client.values("/lens/rgb")[-1].data == Jpeg(picture).data
        published = []
        for n in range(count):
            published.append({"q": [n / 7] * 7, "n": n, "mode": "track" if n % 2 else "rest"})
            space["arm"] = published[-1]
            if n % 20 == 19:  # a client that does not receive loses the oldest of 128
                client.until(lambda n=n: client.values("/arm")[-1]["n"] == n)
        space["arm"]["n"] = 2**60  # one place in it: all of the key is sent, and exactly
        published.append({**published[-1], "n": 2**60})
        space["camera"]["image"] = picture[::-1]
        client.until(lambda: len(client.got["/arm"]) >= count and client.values("/arm")[-1] == published[-1])
        got = client.values("/arm")
        assert [value for value in got if value["n"] != -1] == published
        times = [at for at, _ in client.got["/arm"]]
        assert times == sorted(times)
        client.until(lambda: np.array_equal(client.values("/camera/image")[-1], picture[::-1]))
        space["camera"]["exposure"] = 2.5  # the picture is as it was, and is not sent again
        with Client(client.address) as late:
            late.subscribe("/camera/image", "/camera")
            late.until(lambda: late.got["/camera/image"] and late.got["/camera"])
            np.testing.assert_array_equal(late.values("/camera/image")[-1], picture[::-1])
            assert late.values("/camera")[-1]["exposure"] == 2.5
        process.terminate()
        assert "nothing was left out" in process.communicate()[1]


@pytest.mark.long
def test_foxglove_shows_parameters_and_sets_them_if_it_may(cli, started):
    with blocking.RedisInterface(cli.url, namespace=cli.namespace) as interface:
        gain = blocking.KeyValueStore(interface)["control"].parameter("kp", 2.0, low=0.0, high=10.0)
        with started() as (_, client):
            client.send(op="subscribeParameterUpdates", parameterNames=["control.kp"])
            client.send(op="getParameters", parameterNames=[], id="1")
            client.until(lambda: client.parameters == {"control.kp": 2.0})
            gain.value = 3.5
            client.until(lambda: client.parameters == {"control.kp": 3.5})
            client.send(op="setParameters", parameters=[{"name": "control.kp", "value": 4.0}], id="2")
            client.until(lambda: any("--allow-write" in text for text in client.status))
            assert gain.value == 3.5
        with started("--allow-write") as (_, client):
            for name, value, said in (
                ("control.kp", 99.0, "out of range"),
                ("control.kp", "fast", "not of type"),
                ("control.ki", 1.0, "declared"),
            ):
                client.send(op="setParameters", parameters=[{"name": name, "value": value}], id="3")
                client.until(lambda said=said: any(said in text for text in client.status))
            assert gain.value == 3.5
            client.send(op="setParameters", parameters=[{"name": "control.kp", "value": 4}], id="4")
            eventually(lambda: gain.value == 4.0)
            client.until(lambda: client.parameters.get("control.kp") == 4.0)


def recorded(cli, tmp_path, count):
    """A recording, and what was published at which time."""
    picture = np.arange(48 * 64, dtype="u1").reshape(48, 64)
    file, published = tmp_path / "run.mcap", []
    with (
        cli.running("record", "-o", str(file), "--json") as process,
        blocking.RedisInterface(cli.url, namespace=cli.namespace) as interface,
    ):
        space = blocking.PublishSpace(interface)
        process.stdout.readline()
        for n in range(count):
            published.append({"q": [n / 3, float(-n)], "n": n})
            space["arm"] = published[-1]
            space["camera"] = {"image": np.roll(picture, n, 0), "n": n}
            time.sleep(0.02)
        process.send_signal(2)
        process.communicate(timeout=PATIENCE)
    return file, published, picture


@pytest.mark.long
def test_foxglove_plays_a_recording_from_where_it_is_asked_to(cli, tmp_path, started):
    count = sized(40, 400)
    file, published, picture = recorded(cli, tmp_path, count)
    from reem_async.tools.recording import open_log

    with open_log(file) as log:
        times = {round(at * 1e6): value for at, value in log["arm"].values()}
        middle = sorted(times)[count // 2] * 1000
    with started("--log", str(file), "--rate", "1000") as (_, client):
        client.until(lambda: {"/arm", "/camera", "/camera/image"} <= client.channels.keys())
        client.play("pause")
        client.subscribe("/arm", "/camera/image")
        client.play("play", speed=1.0)
        client.until(lambda: client.got["/arm"] and client.values("/arm")[-1] == published[-1])
        assert {round(at / 1e3): value for at, value in client.got["/arm"]}.items() >= times.items()
        assert [value["n"] for value in client.values("/arm")] == sorted(value["n"] for value in client.values("/arm"))
        client.until(lambda: np.array_equal(client.values("/camera/image")[-1], np.roll(picture, count - 1, 0)))
        client.play("pause", seek=middle)
        client.until(lambda: client.values("/arm")[-1]["n"] == count // 2)
        client.until(lambda: np.array_equal(client.values("/camera/image")[-1], np.roll(picture, count // 2 - 1, 0)))
        client.until(lambda: client.time == middle)
        client.play("play", speed=float("nan"), seek=0)  # from before the beginning: from the beginning
        client.until(lambda: client.values("/arm")[-1] == published[0])
        client.until(lambda: client.values("/arm")[-1] == published[-1])


def entities(file):
    """What rerun's own reader finds in an .rrd file: rows (time in ns, columns) by entity."""
    from rerun.chunk import RrdReader

    found = {}
    for chunk in RrdReader(file).stream():
        table = chunk.to_record_batch()
        if "publish_time" in table.schema.names:
            times = table.column("publish_time").cast("int64").to_pylist()
            rows = found.setdefault(chunk.entity_path, [])
            rows += zip(times, table.drop_columns(["publish_time"]).to_pylist(), strict=True)
    return {entity: sorted(rows, key=lambda row: row[0]) for entity, rows in found.items()}


@pytest.mark.long
def test_rerun_s_file_has_the_newest_states_as_they_were_published(cli, space, tmp_path):
    pytest.importorskip("rerun", reason="rerun-sdk is not installed: pip install rerun-sdk")
    file, count = tmp_path / "run.rrd", sized(100, 1000)
    picture = np.random.default_rng(0).integers(0, 255, (48, 64, 3), "u1")
    space["arm"] = {"q": [0.0, 0.0], "mode": "rest", "t.x": {"deep": True}}
    with cli.running("rerun", "--save", str(file), "--rate", "50") as process:
        assert process.stdout.readline()
        published = {}
        for n in range(count):
            value = [n / 3, float(-n)]
            space["arm"] = {"q": value, "mode": "track" if n > count / 2 else "rest", "t.x": {"deep": True}}
            published[tuple(value)] = n
            time.sleep(0.002)
        space["camera"] = {
            "image": picture,
            "depth": picture[:, :, 0].astype("u2"),
            "jpeg": Jpeg(picture),
            "none": None,
        }
        space["matrix"] = np.eye(3)
        time.sleep(2.0)
        space["arm"].delete()
        time.sleep(0.5)
        process.send_signal(2)
        assert "0 values of other types left out" in process.communicate(timeout=PATIENCE)[1]
    found = entities(str(file))
    numbers = [row["Scalars:scalars"] for _, row in found["/arm/q"]]
    assert numbers[-1] == [(count - 1) / 3, float(1 - count)]
    sent = [published[tuple(each)] for each in numbers[1:]]
    assert sent == sorted(set(sent))
    assert len(sent) > count / 100
    assert [row["TextLog:text"] for _, row in found["/arm/mode"]] == [["rest"], ["track"]]  # only when it changes
    assert [row["Scalars:scalars"] for _, row in found["/arm/t.x/deep"]] == [[1.0]]
    (_, image), (_, depth), (_, jpeg) = (found[f"/camera/{name}"][0] for name in ("image", "depth", "jpeg"))
    assert bytes(image["Image:buffer"][0]) == picture.tobytes()
    assert bytes(depth["DepthImage:buffer"][0]) == picture[:, :, 0].astype("u2").tobytes()
    assert bytes(jpeg["EncodedImage:blob"][0]) == Jpeg(picture).data
    assert "/matrix" in found
    assert any("Clear:is_recursive" in row for _, row in found["/arm"])


@pytest.mark.parametrize(("command", "package"), [("foxglove", "foxglove-sdk"), ("rerun", "rerun-sdk")])
def test_a_missing_package_is_named_with_its_extra(cli, command, package, monkeypatch):
    import sys

    monkeypatch.setitem(sys.modules, command, None)
    assert f"needs {package}: pip install 'reem-async[{command}]'" in cli.error(1, command)


def test_what_cannot_be_shown_is_refused(cli, tmp_path):
    there = tmp_path / "run.rrd"
    there.touch()
    assert "a recording is not changed" in cli.error(2, "foxglove", "--log", str(there), "--allow-write")
    assert "use one of" in cli.error(2, "rerun", "--spawn", "--save", "x.rrd")
    assert "names a place in a key" in cli.error(2, "foxglove", "arm.q")
    if pytest.importorskip("rerun", reason="rerun-sdk is not installed: pip install rerun-sdk"):
        assert "--force" in cli.error(2, "rerun", "--save", str(there))
        assert "no viewer of Rerun answers" in cli.error(1, "rerun", "--connect", "rerun+http://127.0.0.1:9/proxy")
        assert "no address of Rerun" in cli.error(2, "rerun", "--connect", "nowhere")
