"""Training sets: the episodes of a recording as frames at one rate, in Parquet, npz or a LeRobot dataset.

`TrainingSet` yields frames, one by one, and counts those that are left out. The writers below take them from it, so
memory is bounded by what a writer keeps: some frames, or in a LeRobot dataset one episode without its pictures.
"""

from __future__ import annotations

import io
import itertools
import json
import math
import zipfile
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import ExitStack
from dataclasses import dataclass, field
from importlib import import_module
from pathlib import Path as FilePath
from tempfile import TemporaryDirectory, TemporaryFile
from typing import IO, Any, NamedTuple

import numpy as np

from ...errors import BadData, BadType, BadValue
from ...plan.arguments import check_number
from ...plan.paths import Path, shorten, show
from ...plan.trees import MISSING
from ...ships.images import EncodedImage, Jpeg, Png
from .align import EXACT
from .episodes import Episode
from .export import appearing, pyarrow, write_array
from .log import Log
from .mcap_reader import Numbers

QUALITY = 95
"""Of the JPEG that is made of pictures which were published as arrays; the others stay as they were published."""

NEAR = 0.75
"""Frames that a value may be away from its frame, unless a tolerance is given. A picture that was lost leaves a hole of
more, and a camera that trembles by a quarter of a frame leaves none."""

_COLUMNS = ("episode", "frame", "time", "task")

# A row group of a Parquet file ends with the frame that takes it to so many.
_GROUP_FRAMES = 1000
_GROUP_BYTES = 64 << 20

Picture = Jpeg | Png


class TrainingFrame(NamedTuple):
    """One frame of a training set."""

    episode: int  # from 0, among those that are kept
    number: int  # from 0 in the episode, counting those that are left out
    time: float  # in seconds since 1970
    task: str
    values: dict[str, Any]  # by path: numbers as float64, pictures as their files


@dataclass(slots=True)
class ExportedEpisode:
    """What became of one episode in an export.

    Attributes:
        episode: Its number.
        task: The text at `task` in its dict.
        start: When it began, in seconds since 1970.
        end: When it ended.
        ended: Whether its end was recorded.
        frames: How many it has.
        missing: How many are left out, since at least one path has no value near enough.
        by_path: How many each path is missing in.
    """

    episode: int
    task: str
    start: float
    end: float
    ended: bool
    frames: int = 0
    missing: int = 0
    by_path: dict[str, int] = field(default_factory=dict)


class TrainingSet:
    """The frames of the episodes of a recording that are not discarded, one by one.

    Args:
        log: The recording.
        rate: Frames per second.
        state: Paths of numbers that are observed; of a dict, all numbers in it.
        action: Paths of numbers that are commanded.
        images: Paths of pictures.
        episodes: The path whose dicts are the episodes. If it never held one, all of the recording is one episode.
        method: See `Log.align`.
        tolerance: Seconds likewise; three quarters of a frame if not given.
        clock: Whose times count, as in `Log.align`.
        max_missing: The share of frames that may be missing in an episode; any if not given.
        progress: Called with the frames done and all of them.

    Attributes:
        reports: An `ExportedEpisode` of each.
        discarded: How many episodes are left out.
        has_episodes: Whether there were any in the recording.

    Raises:
        BadType, BadValue: An argument that means nothing, or a path that holds what it should not.
        MissingKey: Nothing was recorded at a path.
        BadData: Too many frames are missing in an episode.
    """

    def __init__(
        self,
        log: Log,
        *,
        rate: float,
        state: Sequence[str] = (),
        action: Sequence[str] = (),
        images: Sequence[str] = (),
        episodes: str = "episode",
        method: str | Mapping[str, str] = "nearest",
        tolerance: float | Mapping[str, float] | None = None,
        clock: str = "recorder",
        max_missing: float | None = None,
        progress: Callable[[int, int], None] | None = None,
    ) -> None:
        if not (state or action or images):
            raise BadValue("nothing to export: name paths with --state, --action or --image")
        log.align([*state, *action, *images], rate=rate)  # refuses paths of which nothing was recorded
        if max_missing is not None:
            check_number("max_missing", max_missing, "use a share from 0 to 1", most=1)
        self.rate = rate
        self.state, self.action = _numbers_of(log, state), _numbers_of(log, action)
        self.images = list(dict.fromkeys(images))
        self.paths = list(dict.fromkeys([*self.state, *self.action, *self.images]))
        taken = [path for path in self.paths if path in _COLUMNS]
        if taken:
            raise BadValue(f"{taken[0]} is the name of another column; publish it below another key")
        near = NEAR / rate
        self._options: dict[str, Any] = {
            "rate": rate,
            "method": method,
            "clock": clock,
            "tolerance": near if tolerance is None else tolerance,
        }
        if isinstance(tolerance, Mapping):
            self._options["tolerance"] = dict.fromkeys(self.paths, near) | dict(tolerance)
        self.log = log.raw
        self._max_missing = max_missing
        self._progress = progress or (lambda done, total: None)
        found = log.episodes(episodes, clock=clock)
        self.has_episodes = bool(found)
        self.episodes = [it for it in found if not it.discarded]
        self.discarded = len(found) - len(self.episodes)
        if not found:
            self.episodes = [Episode(log.start, log.end, {}, ended=True)]
        self.reports: list[ExportedEpisode] = []
        self._total = sum(round(it.duration * rate) for it in self.episodes)
        self._shapes: dict[str, tuple[int, ...]] = {}
        self.log.align(self.paths, **self._options)  # refuses what it cannot do before there is a file
        self._frames = self._made()
        self.first = next(self._frames, None)

    def __iter__(self) -> Iterator[TrainingFrame]:
        """Yield all frames, once."""
        if self.first is not None:
            yield self.first
            yield from self._frames

    def shape(self, path: str) -> tuple[int, ...]:
        """Return the shape of the first value of a path."""
        return self._shapes[path]

    def _made(self) -> Iterator[TrainingFrame]:
        done = 0
        for number, episode in enumerate(self.episodes):
            task = str(episode.data.get("task", ""))
            report = ExportedEpisode(number, task, episode.start, episode.end, episode.ended)
            self.reports.append(report)
            aligned = self.log.align(self.paths, start=self._begin(episode), end=episode.end, **self._options)
            for count, (time, found) in enumerate(aligned.rows()):
                lacking = [path for path in self.paths if path not in found]
                for path in lacking:
                    report.by_path[path] = report.by_path.get(path, 0) + 1
                if lacking:
                    report.missing += 1
                else:
                    report.frames += 1
                    yield TrainingFrame(
                        number, count, time, task, {path: self._value(path, found[path]) for path in self.paths}
                    )
                done += 1
                self._progress(done, max(self._total, done))
            self._check(report)

    def _begin(self, episode: Episode) -> float:
        """Return the instant of the first frame: in step with the first picture, so that each has one of its own."""
        if self.images:
            options = {"start": episode.start, "end": episode.end, "clock": self._options["clock"]}
            for time, _ in self.log.align(self.images[:1], on=self.images[0], **options).rows():
                if time >= episode.start:
                    return time - math.floor((time - episode.start) * self.rate) / self.rate
        return episode.start

    def _check(self, report: ExportedEpisode) -> None:
        total = report.frames + report.missing
        if self._max_missing is not None and report.missing > self._max_missing * total:
            raise BadData(
                f"episode {report.episode} ({report.task}) lacks {report.missing} of {total} frames "
                f"({_listed(report.by_path)}), more than the share {self._max_missing:g} that may be missing; discard "
                "it, or allow more"
            )

    def _value(self, path: str, value: Any) -> Any:
        if path in self.images:
            picture = _as_picture(path, value)
            self._shapes.setdefault(path, picture.shape)
            return picture
        array = _as_numbers(path, value)
        if self._shapes.setdefault(path, array.shape) != array.shape:
            raise BadValue(f"{path} has the shape {array.shape} and had {self._shapes[path]} before; name its parts")
        return array


def _numbers_of(log: Log, paths: Sequence[str]) -> list[str]:
    """Return paths of numbers: in place of a dict those inside of it, as it was at first."""
    found: list[str] = []
    for path in paths:
        place = log[path]
        _, value = next(place.values(), (0.0, MISSING))
        if value is MISSING:
            raise BadValue(f"{path} had no value that can be read")
        found += [show(each) for each in _leaves(place.path, value)] if isinstance(value, dict) else [path]
        _as_numbers(path, value)
    return list(dict.fromkeys(found))


def _leaves(path: Path, value: Any) -> Iterator[Path]:
    if not isinstance(value, dict):
        yield path
        return
    for key, item in value.items():
        yield from _leaves((*path, key), item)


def _as_numbers(path: str, value: Any) -> Numbers:
    """Return numbers as an array of float64; raise BadType for what is none, BadValue for what floats would round."""
    if isinstance(value, dict):
        for key, item in value.items():
            _as_numbers(f"{path}.{key}", item)
        return np.empty(0)
    try:
        array = np.asarray(value) if isinstance(value, bool | int | float | list | np.ndarray) else None
    except ValueError:  # lists of other lengths in a list
        array = None
    if array is None or array.dtype.kind not in "biuf" or array.ndim > 2:
        cure = "use --image for a picture, and name the paths of the numbers beside what is none"
        raise BadType(f"{path} is {shorten(value)}, which is not a number, a vector or a matrix; {cure}")
    if array.dtype.kind in "iu" and array.size and int(np.abs(array).max()) > EXACT:
        raise BadValue(f"{path} is {shorten(value)}, which a float would round; leave it out")
    return array.astype(np.float64)


def _as_picture(path: str, value: Any) -> Picture:
    """Return a picture as the file that it was published as, or else encoded; raise BadType for what is none."""
    if isinstance(value, Jpeg | Png):
        return value
    if isinstance(value, bytes):
        return Png.from_file(value) if value.startswith(b"\x89PNG") else Jpeg.from_file(value)
    if not isinstance(value, np.ndarray):
        raise BadType(f"{path} is {shorten(value)}, not a picture; use --state or --action for numbers")
    lossless = value.dtype == np.uint16 or (value.ndim == 3 and value.shape[2] == 4)
    return Png(value) if lossless else Jpeg(value, quality=QUALITY)


def _listed(by_path: Mapping[str, int]) -> str:
    return ", ".join([f"{path} {count}" for path, count in by_path.items()])


def export_training(frames: TrainingSet, kind: str, target: FilePath, *, overwrite: bool = False) -> None:
    """Write the frames of a training set as a file, or as a directory for "lerobot".

    "parquet" has the columns episode, frame, time and task, and one for each path: numbers, lists of numbers, and
    pictures as `datasets` stores them. "npz" has an array of each, pictures decoded. "lerobot" is written by the
    package lerobot. The file appears once it is complete, and nothing is left if it fails.

    Raises:
        BadValue: The file is there already, no frame is left, or the format cannot hold a path.
        BadData: Too many frames are missing in an episode.
    """
    if frames.first is None:
        missing = [f"episode {it.episode}: {_listed(it.by_path)}" for it in frames.reports if it.missing]
        why = f"; missing are {'; '.join(missing[:5])}; see --tolerance" if missing else ""
        raise BadValue(f"nothing to export: no frame of {len(frames.episodes)} episodes has a value of each path{why}")
    if kind != "lerobot":
        with appearing(target, frames.log, overwrite=overwrite) as path:
            WRITERS[kind](frames, path)
        return
    if target.exists():
        raise BadValue(f"{target} is there already; remove it, or choose another name")
    with TemporaryDirectory(prefix=".", suffix=".reem.part", dir=target.parent) as hidden:
        WRITERS[kind](frames, FilePath(hidden, target.name))
        FilePath(hidden, target.name).rename(target)


def _batches(frames: Iterable[TrainingFrame]) -> Iterator[list[TrainingFrame]]:
    batch: list[TrainingFrame] = []
    size = 0
    for frame in frames:
        batch.append(frame)
        size += sum(len(it.data) for it in frame.values.values() if isinstance(it, EncodedImage))
        if len(batch) >= _GROUP_FRAMES or size >= _GROUP_BYTES:
            yield batch
            batch, size = [], 0
    if batch:
        yield batch


def _parquet(frames: TrainingSet, target: FilePath) -> None:
    arrow, parquet = pyarrow()
    file = arrow.struct([("bytes", arrow.binary()), ("path", arrow.string())])
    fields = [("episode", arrow.int64()), ("frame", arrow.int64()), ("time", arrow.float64()), ("task", arrow.string())]
    for path in frames.paths:
        kind = file if path in frames.images else arrow.float64()
        for _ in () if path in frames.images else frames.shape(path):
            kind = arrow.list_(kind)
        fields.append((path, kind))
    # `datasets` opens these columns as pictures by its own note.
    features = {path: {"_type": "Image"} for path in frames.images}
    notes = {"huggingface": json.dumps({"info": {"features": features}}), "reem.rate": f"{frames.rate:g}"}
    schema = arrow.schema(fields, metadata=notes)
    with parquet.ParquetWriter(target, schema) as writer:
        for batch in _batches(frames):
            columns: list[list[Any]] = [list(column) for column in zip(*[frame[:4] for frame in batch], strict=True)]
            columns += [[_cell(frame.values[path]) for frame in batch] for path in frames.paths]
            data = dict(zip(schema.names, columns, strict=True))
            writer.write_table(arrow.table(data, schema=schema))


def _cell(value: Any) -> Any:
    return {"bytes": value.data, "path": None} if isinstance(value, EncodedImage) else value.tolist()


def _npz(frames: TrainingSet, target: FilePath) -> None:
    """Write the arrays in files of their own first, since each begins with how many frames there are."""
    heads: list[tuple[Any, ...]] = []
    forms: dict[str, np.dtype[Any]] = {}
    with ExitStack() as stack:
        files: dict[str, IO[bytes]] = {
            path: stack.enter_context(TemporaryFile(dir=target.parent)) for path in frames.paths
        }
        for frame in frames:
            heads.append(frame[:4])
            for path, value in frame.values.items():
                array = value.decode() if isinstance(value, EncodedImage) else value
                known = forms.setdefault(path, array.dtype), frames.shape(path)
                if (array.dtype, array.shape) != known:
                    raise BadValue(
                        f"{path} is {array.dtype}{list(array.shape)} and was {known[0]}{list(known[1])}; use Parquet"
                    )
                files[path].write(array.tobytes())
        with zipfile.ZipFile(target, "w", zipfile.ZIP_STORED, allowZip64=True) as archive:
            for name, column in zip(_COLUMNS, zip(*heads, strict=True), strict=True):
                array = np.array(column)
                write_array(archive, name, array.dtype, array.shape, io.BytesIO(array.tobytes()))
            for path, file in files.items():
                write_array(archive, path, forms[path], (len(heads), *frames.shape(path)), file)


def _lerobot(frames: TrainingSet, target: FilePath) -> None:
    """Write a dataset with lerobot's own writer: the layout, statistics and videos are its own."""
    if frames.rate != int(frames.rate):
        raise BadValue(f"rate={frames.rate:g} is not a whole number, as LeRobot needs it")
    features: dict[str, Any] = {}
    for name, paths in (("observation.state", frames.state), ("action", frames.action)):
        names = [text for path in paths for text in _names(path, frames.shape(path))]
        if names:
            features[name] = {"dtype": "float32", "shape": (len(names),), "names": names}
    for path in frames.images:
        shape = (*frames.shape(path)[:2], 3)
        features[f"observation.images.{path}"] = {
            "dtype": "video",
            "shape": shape,
            "names": ["height", "width", "channels"],
        }
    try:
        dataset_class = import_module("lerobot.datasets.lerobot_dataset").LeRobotDataset
    except ModuleNotFoundError as error:
        raise BadValue(
            f"a LeRobot dataset needs the package lerobot: pip install lerobot ({error.name} is missing)"
        ) from None
    # The name is that of the directory; lerobot publishes under another one, if asked to.
    dataset = dataset_class.create(
        repo_id=f"reem/{target.name}",
        fps=int(frames.rate),
        features=features,
        root=target,
        use_videos=bool(frames.images),
    )
    for _, episode in itertools.groupby(frames, key=lambda frame: frame.episode):
        for frame in episode:
            dataset.add_frame(_lerobot_frame(frames, frame) | {"task": frame.task})
        dataset.save_episode()
    dataset.finalize()


def _names(path: str, shape: tuple[int, ...]) -> list[str]:
    return [path + "".join([f"[{index}]" for index in place]) for place in np.ndindex(shape)]


def _lerobot_frame(frames: TrainingSet, frame: TrainingFrame) -> dict[str, Any]:
    found: dict[str, Any] = {}
    for name, paths in (("observation.state", frames.state), ("action", frames.action)):
        if paths:
            found[name] = np.concatenate([frame.values[path].ravel() for path in paths]).astype(np.float32)
    for path in frames.images:
        array = frame.values[path].decode()
        if array.dtype != np.uint8 or array.shape[:2] != frames.shape(path)[:2]:
            raise BadValue(f"{path} is {frame.values[path].summary}; LeRobot takes pictures of uint8 and of one size")
        found[f"observation.images.{path}"] = (
            np.repeat(array[:, :, np.newaxis], 3, axis=2) if array.ndim == 2 else array[:, :, :3]
        )
    return found


WRITERS: dict[str, Callable[[TrainingSet, FilePath], None]] = {
    "lerobot": _lerobot,
    "npz": _npz,
    "parquet": _parquet,
}
