"""Training sets: what is read back is what was published, nearest in time, and what is missing is counted."""

import json
import math
import sys

import numpy as np
import pytest
from clikit import invoked
from conftest import sized
from test_recording_align import BEGUN, recorded

from reem import Jpeg, Png
from reem_async.errors import BadData, BadInput
from reem_async.plan.trees import MISSING
from reem_async.tools.recording.training import TrainingSet, export_training

parquet = pytest.importorskip("pyarrow.parquet")

PATHS = {"state": ["arm.q", "arm.grip"], "action": ["cmd.q"], "images": ["cam.rgb"]}
OPTIONS = ["--rate", 30, "--state", "arm.q", "--state", "arm.grip", "--action", "cmd.q", "--image", "cam.rgb"]
COLUMNS = ["episode", "frame", "time", "task", "arm.q", "arm.grip", "cmd.q", "cam.rgb"]


def picture(number):
    return Jpeg(np.full((24, 32, 3), number % 256, np.uint8), quality=95)


def published(seconds, *episodes, lost=()):
    """What publishers with clocks that tremble make: pictures at 30 Hz, states at 200 Hz, commands at 50 Hz."""
    random = np.random.default_rng(1)
    rates = {("cam", "rgb"): 30, ("arm",): 200, ("cmd", "q"): 50}
    make = {
        ("cam", "rgb"): picture,
        ("arm",): lambda n: {"q": [n / 200, -n / 200, 0.1 * n], "grip": n},
        ("cmd", "q"): lambda n: np.array([n / 50, 1.0], np.float32),
    }
    changes = [
        (number / rate + 0.003 + random.uniform(0, 0.002), path, make[path](number))
        for path, rate in rates.items()
        for number in range(int(seconds * rate))
        if (path, number) not in lost
    ]
    return changes + [(at, ("episode",), value) for at, value in episodes]


def nearest(changes, path, time):
    return min((change for change in changes if change[1] == path), key=lambda change: abs(change[0] - time))


@pytest.fixture
def five(file):
    """Five episodes of some seconds, one of which is discarded beside them, with what was published in all."""
    length = sized(2, 10)
    episodes = []
    for number in range(6):
        begun = number * (length + 1)
        note = {"task": f"task {number % 2}", "number": number}
        verdict = note | {"outcome": "discarded" if number == 2 else "success"}
        episodes += [(begun, note), (begun + length - 0.01, verdict), (begun + length, None)]
    changes = published(6 * (length + 1), *episodes)
    recorded(file, changes).close()
    return file, changes, length


def test_five_episodes_are_read_back_as_they_were_published(five, tmp_path):
    file, changes, length = five
    run = invoked("log", "export", file, "--to", "parquet", *OPTIONS, "--max-missing", 0.01, "--json")
    assert run.returncode == 0, run.stderr
    said = json.loads(run.stdout)
    assert (said["discarded"], len(said["episodes"])) == (1, 5)
    assert [each["missing"] for each in said["episodes"]] == [0] * 5
    table = parquet.read_table(file.with_suffix(".parquet"))
    assert table.column_names == COLUMNS
    rows = table.to_pylist()
    assert len(rows) == pytest.approx(5 * 30 * length, abs=5)
    for row in rows[:: sized(7, 1)]:
        time = row["time"] - BEGUN
        for path, column, value in (
            (("cam", "rgb"), "cam.rgb", lambda found: {"bytes": found.data, "path": None}),
            (("arm",), "arm.q", lambda found: found["q"]),
            (("arm",), "arm.grip", lambda found: found["grip"]),
            (("cmd", "q"), "cmd.q", lambda found: found.tolist()),
        ):
            at, _, found = nearest(changes, path, time)
            assert row[column] == value(found), column
            assert abs(at - time) <= 0.5 / 30
    assert [row["frame"] for row in rows if row["episode"] == 1] == list(range(sum(it["episode"] == 1 for it in rows)))
    tasks = {(row["episode"], row["task"]) for row in rows}
    assert tasks == {(place, f"task {number % 2}") for place, number in enumerate((0, 1, 3, 4, 5))}


def test_the_publishers_times_count_where_the_recorder_was_late(file, tmp_path):
    """It had no processor for 0.4 s at a time: by its own times, frames are missing."""
    changes = published(3, (0, {"task": "t"}), (2.9, None))
    recorded(file, changes, arrived=lambda at: math.floor(at / 0.4 + 1) * 0.4).close()
    for clock in ("recorder", "publisher"):
        run = invoked("log", "export", file, "-o", tmp_path / f"{clock}.parquet", *OPTIONS, "--clock", clock, "--json")
        assert run.returncode == 0, run.stderr
        (episode,) = json.loads(run.stdout)["episodes"]
        assert (episode["missing"] == 0) == (clock == "publisher")
    rows = parquet.read_table(tmp_path / "publisher.parquet").to_pylist()
    assert len(rows) == pytest.approx(2.9 * 30, abs=1)
    for row in rows:
        at, _, found = nearest(changes, ("arm",), row["time"] - BEGUN)
        assert (row["arm.q"], abs(at - row["time"] + BEGUN) <= 0.5 / 30) == (found["q"], True)
        at, _, found = nearest(changes, ("cam", "rgb"), row["time"] - BEGUN)
        assert (row["cam.rgb"]["bytes"], abs(at - row["time"] + BEGUN) <= 0.5 / 30) == (found.data, True)


def test_pandas_and_datasets_open_it(five, tmp_path):
    file, _, _ = five
    target = tmp_path / "set.parquet"
    assert invoked("log", "export", file, "-o", target, *OPTIONS).returncode == 0
    pandas, datasets = pytest.importorskip("pandas"), pytest.importorskip("datasets")
    frame = pandas.read_parquet(target)
    assert list(frame.columns) == COLUMNS
    assert frame["arm.q"][3].shape == (3,)
    opened = datasets.load_dataset("parquet", data_files=str(target), cache_dir=str(tmp_path / "cache"))["train"]
    assert opened.features["cam.rgb"] == datasets.Image()
    assert opened[0]["cam.rgb"].size == (32, 24)
    assert opened[5]["arm.q"] == frame["arm.q"][5].tolist()


def test_npz_has_an_array_for_each_column(five, tmp_path):
    file, changes, _ = five
    target = tmp_path / "set.npz"
    assert invoked("log", "export", file, "-o", target, *OPTIONS).returncode == 0
    with np.load(target) as arrays:
        assert sorted(arrays) == sorted(COLUMNS)
        assert arrays["cam.rgb"].shape == (len(arrays["time"]), 24, 32, 3)
        last = nearest(changes, ("cam", "rgb"), arrays["time"][-1] - BEGUN)[2].decode()
        assert np.array_equal(arrays["cam.rgb"][-1], last)
        assert arrays["arm.q"].dtype == arrays["arm.grip"].dtype == np.float64
        assert arrays["task"][0] == "task 0"


def test_frames_in_which_a_value_is_missing_are_counted_and_can_fail_the_export(file, tmp_path):
    """Of a picture that was lost, and of a state that stopped: never the value of another frame."""
    lost = {(("cam", "rgb"), 10), (("cam", "rgb"), 11), *((("arm",), n) for n in range(100, 140))}
    lost |= {(("cam", "rgb"), 0)}  # nor is the beginning left out without a word
    changes = published(2, (0, {"task": "t"}), lost=lost)
    with recorded(file, changes) as log:
        frames = TrainingSet(log, rate=30, **PATHS)
        export_training(frames, "parquet", tmp_path / "set.parquet")
        (report,) = frames.reports
        assert (report.missing, report.frames, report.ended) == (3 + 5, 60 - 8, False)
        assert report.by_path == {"cam.rgb": 3, "arm.q": 5, "arm.grip": 5}
        numbers = parquet.read_table(tmp_path / "set.parquet")["frame"].to_pylist()
        assert sorted({*range(60)} - {*numbers}) == [0, 10, 11, 16, 17, 18, 19, 20]
        with pytest.raises(BadData, match=r"episode 0 \(t\) lacks 8 of 60 frames .*cam.rgb 3.*discard it"):
            export_training(TrainingSet(log, rate=30, max_missing=0.05, **PATHS), "npz", tmp_path / "other.npz")
        rough = TrainingSet(log, rate=30, tolerance={"arm.q": 1, "arm.grip": 1}, max_missing=0.06, **PATHS)
        export_training(rough, "npz", tmp_path / "other.npz")
    assert sorted(path.name for path in tmp_path.iterdir()) == ["other.npz", "run.mcap", "set.parquet"]


def test_pictures_that_were_arrays_are_encoded_and_may_change_their_size(file, tmp_path):
    """Depth stays exact. npz, which needs one size, says so and leaves nothing."""
    depth = np.arange(600, dtype=np.uint16).reshape(20, 30)
    changes = [(n / 10, ("cam",), {"rgb": np.full((8 + n, 8, 3), 90, np.uint8), "depth": depth}) for n in range(4)]
    with recorded(file, [*changes, (0.31, ("x",), 1)]) as log:
        frames = TrainingSet(log, rate=10, images=["cam.rgb", "cam.depth"])
        export_training(frames, "parquet", tmp_path / "set.parquet")
        with pytest.raises(BadInput, match=r"cam.rgb is uint8\[9, 8, 3\] and was uint8\[8, 8, 3\]; use Parquet"):
            export_training(TrainingSet(log, rate=10, images=["cam.rgb"]), "npz", tmp_path / "set.npz")
    rows = parquet.read_table(tmp_path / "set.parquet").to_pylist()
    assert [Jpeg(row["cam.rgb"]["bytes"]).shape for row in rows] == [(8 + n, 8, 3) for n in range(4)]
    assert np.array_equal(Png(rows[0]["cam.depth"]["bytes"]).decode(), depth)
    assert sorted(path.name for path in tmp_path.iterdir()) == ["run.mcap", "set.parquet"]


@pytest.mark.parametrize(
    ("options", "said"),
    [
        (["--state", "a.x"], "needs --rate"),
        (["a", "--rate", 10, "--state", "a.x"], "name paths with --state"),
        (["--rate", 10], "nothing to export: name paths"),
        (["--rate", 0, "--state", "a.x"], "rate=0"),
        (["--rate", 10, "--state", "b"], "nothing was recorded at 'b'"),
        (["--rate", 10, "--state", "a"], "a.text is 'text', which is not a number"),
        (["--rate", 10, "--state", "a.image"], "use --image for a picture"),
        (["--rate", 10, "--state", "a.long"], "which a float would round"),
        (["--rate", 10, "--image", "a.x"], "a.x is 1, not a picture"),
        (["--rate", 10, "--state", "a.x", "--to", "csv"], "none of parquet, npz, lerobot"),
        (["--rate", 10, "--state", "a.x", "--tolerance", "a.x=near"], "not of the form SECONDS"),
        (["--rate", 10, "--state", "a.x", "--tolerance", "1", "--tolerance", "a.x=2"], "name each path"),
        (["--rate", 10, "--state", "a.x", "--method", "a.y=linear"], "none of the paths: a.x"),
        (["--rate", 10, "--state", "a.x", "--max-missing", 2], "max_missing=2"),
        (["--rate", 10, "--state", "task"], "the name of another column"),
        (["--rate", 10, "--state", "a.x", "--episodes", "gone"], "no frame of 0 episodes"),
    ],
)
def test_what_is_no_training_set_is_refused_and_leaves_nothing(options, said, file, tmp_path):
    image = np.zeros((8, 8, 3), np.uint8)
    changes = [(0, ("a",), {"x": 1, "y": 2, "text": "text", "image": image, "long": 2**60}), (0, ("task",), 1)]
    changes += [(1, ("gone",), {"discard": True}), (2, ("gone",), MISSING)]
    recorded(file, changes).close()
    run = invoked("log", "export", file, "--to", "parquet", *options)
    assert (run.returncode, said in run.stderr) in ((2, True), (3, True)), run.stderr
    assert [path.name for path in tmp_path.iterdir()] == ["run.mcap"]


def test_what_lerobot_is_missing_for_is_said(five, tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "lerobot", None)
    run = invoked("log", "export", five[0], "--to", "lerobot", *OPTIONS)
    assert (run.returncode, "needs the package lerobot: pip install lerobot" in run.stderr) == (2, True), run.stderr
    assert [path.name for path in tmp_path.iterdir()] == ["run.mcap"]


def test_a_lerobot_dataset_has_what_was_published(five, tmp_path):
    """Written by lerobot, and read by it; in float32, as its states and actions are."""
    lerobot = pytest.importorskip("lerobot.datasets.lerobot_dataset")
    file, target = five[0], tmp_path / "set"
    for to, name in (("lerobot", target), ("parquet", tmp_path / "set.parquet")):
        run = invoked("log", "export", file, "--to", to, "-o", name, *OPTIONS)
        assert run.returncode == 0, run.stderr
    dataset = lerobot.LeRobotDataset("reem/set", root=target)
    assert (dataset.num_episodes, dataset.fps) == (5, 30)
    assert dataset.features["observation.state"]["names"] == ["arm.q[0]", "arm.q[1]", "arm.q[2]", "arm.grip"]
    rows = parquet.read_table(tmp_path / "set.parquet").to_pylist()
    assert len(rows) == dataset.num_frames
    for row, item in zip(rows, dataset.hf_dataset, strict=True):
        assert item["observation.state"].tolist() == pytest.approx([*row["arm.q"], row["arm.grip"]], rel=1e-6)
        assert item["action"].tolist() == pytest.approx(row["cmd.q"], rel=1e-6)
        assert int(item["episode_index"]) == row["episode"]
