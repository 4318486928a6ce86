"""A bridge between ROS 2 and REEM: topics and paths, parameters both ways, as a YAML file says.

    source /opt/ros/jazzy/setup.bash
    python ros2_bridge.py ros2_bridge.yaml      (in a clone: python -m examples.ros2_bridge examples/ros2_bridge.yaml)

It runs under the Python of ROS 2 Jazzy or newer (REEM needs Python 3.11), with `pip install reem-async` there. REEM's
own tests run it with a real Redis server and a stub of rclpy's API, tests/rosstub.py. It was not run under ROS 2.

A message is a dict of its fields. Numeric arrays are numpy arrays. `data` of a sensor_msgs/msg/Image is the picture:
rows, columns, and channels in the order red, green, blue.
"""

from __future__ import annotations

import argparse
import array
import importlib
import logging
import math
import operator
import re
import sys
import threading
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import yaml
from redis.exceptions import RedisError

import reem

try:
    import rclpy
    from rcl_interfaces.msg import ParameterEvent
    from rclpy.executors import ExternalShutdownException
    from rclpy.parameter import Parameter, parameter_value_to_python
    from rclpy.parameter_client import AsyncParameterClient
    from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy, qos_profile_parameter_events
    from rclpy.utilities import remove_ros_args
except ImportError as error:
    sys.exit(f"{error}; run this with the Python of ROS 2, after: source /opt/ros/jazzy/setup.bash")

logger = logging.getLogger("ros2_bridge")

TIMEOUT = 2.0  # seconds to wait for another node's answer
MOST_REPORTED = 100  # different problems of one entry


# --- The YAML file ---


class Wrong(Exception):
    """An entry of the file cannot be used."""


class Entry(dict[str, Any]):
    """A mapping of the file, with the line of each key."""

    lines: dict[str, int]
    where: str

    def wrong(self, text: str, key: str | None = None) -> Wrong:
        file, line = self.where.rsplit(":", 1)
        return Wrong(f"{file}:{self.lines.get(key or '', int(line))}: {text}")


class Loader(yaml.SafeLoader):
    """Makes an `Entry` of each mapping."""


def _entry(loader: Loader, node: yaml.MappingNode) -> Entry:
    file = Path(node.start_mark.name).name
    pairs = loader.construct_pairs(node, deep=True)
    entry = Entry((str(key), value) for key, value in pairs)
    entry.where = f"{file}:{node.start_mark.line + 1}"
    entry.lines = {str(key.value): key.start_mark.line + 1 for key, _ in node.value}
    if len(entry) < len(pairs):
        names = [str(key) for key, _ in pairs]
        twice = next(key for n, key in enumerate(names) if key in names[:n])
        raise entry.wrong(f"{twice!r} is there twice; remove one", twice)
    return entry


Loader.add_constructor("tag:yaml.org,2002:map", _entry)
# The keys of each mapping; "!" marks those that it must have. A value is a text unless `KINDS` says another type.
FILE, TOPIC = "server namespace topics parameters", "topic! type! path! direction! qos ttl"
PARAMETER, QOS = "node name! path! default", "reliability durability depth"
KINDS: dict[str, tuple[type, ...]] = {
    "topics": (list,),
    "parameters": (list,),
    "qos": (str, Entry),
    "ttl": (int, float),
    "depth": (int,),
    "default": (object,),
}
WORDS = {
    "direction": ("from_ros", "to_ros"),
    "reliability": ("reliable", "best_effort"),
    "durability": ("volatile", "transient_local"),
}
QOS_NAMES: dict[str, dict[str, Any]] = {
    "default": {},
    "sensor_data": {"reliability": "best_effort", "depth": 5},
    "latched": {"durability": "transient_local", "depth": 1},
}


def checked(entry: Any, keys: str, parent: Entry | None = None, where: str = "") -> Entry:
    """Return an entry if it has what it must and nothing unknown."""
    known = keys.replace("!", "").split()
    if not isinstance(entry, Entry):
        found = f"{entry!r:.60} is not a mapping; use {', '.join(known)}"
        raise parent.wrong(found) if parent is not None else Wrong(f"{where}: {found}")
    for key, value in entry.items():
        if key not in known:
            raise entry.wrong(f"unknown key {key!r}; use {', '.join(known)}", key)
        kinds = KINDS.get(key, (str,))
        if not isinstance(value, kinds) or (isinstance(value, bool) and kinds != (object,)):
            raise entry.wrong(f"{key} is {value!r:.60}, not {' or '.join(kind.__name__ for kind in kinds)}", key)
        if key in WORDS and value not in WORDS[key]:
            raise entry.wrong(f"{key} is {value!r:.60}; use {' or '.join(WORDS[key])}", key)
    for key in keys.split():
        if key.endswith("!") and key[:-1] not in entry:
            raise entry.wrong(f"{key[:-1]} is missing")
    return entry


def load(file: str) -> Entry:
    """Return the checked file. Raises Wrong, which names file and line."""
    try:
        with open(file, "rb") as stream:
            content = yaml.load(stream, Loader)
    except (OSError, yaml.YAMLError) as error:
        raise Wrong(f"{file}: {error}") from None
    found = checked(content, FILE, where=file)
    topics = [checked(each, TOPIC, found) for each in found.setdefault("topics", [])]
    parameters = [checked(each, PARAMETER, found) for each in found.setdefault("parameters", [])]
    for each in topics:
        qos = each.get("qos", "default")
        if isinstance(qos, str) and qos not in QOS_NAMES:
            raise each.wrong(f"qos is {qos!r:.60}; use {', '.join(QOS_NAMES)} or a mapping of {QOS}", "qos")
        each["qos"] = checked(qos, QOS) if isinstance(qos, Entry) else QOS_NAMES[qos]
        if each["qos"].get("depth", 1) < 1:
            raise qos.wrong(f"depth is {qos['depth']}; use at least 1", "depth")
        if "ttl" in each and (each["direction"] == "from_ros" or not 0 < each["ttl"] < math.inf):
            raise each.wrong(f"ttl is {each['ttl']}; use seconds over 0, and to_ros only", "ttl")
        for other in topics:
            if other["topic"] == each["topic"] and other["direction"] != each["direction"]:
                raise each.wrong(f"topic {each['topic']} goes the other way at {other.where}; use another one", "topic")
    # Two entries that write to one place, or pass on in a circle, would never end.
    for n, each in enumerate(entries := (*topics, *parameters)):
        each["path"] = _path(each)
        if not each.get("node", "/").startswith("/"):
            raise each.wrong(f"node is {each['node']!r:.60}; use its full name, such as /{each['node']:.60}", "node")
        for other in entries[:n]:
            short = min(len(each["path"]), len(other["path"]))
            both_read = each.get("direction") == other.get("direction") == "to_ros"
            if each["path"][:short] == other["path"][:short] and not both_read:
                name = ".".join(each["path"])
                raise each.wrong(f"path {name} is used at {other.where}, too; use another one", "path")
    return found


def _path(entry: Entry) -> tuple[str, ...]:
    names = tuple(entry["path"].split("."))
    if not all(re.fullmatch(r"\w[\w-]*", name) for name in names):
        raise entry.wrong(f"path is {entry['path']!r:.60}; use names with dots between, such as arm.joints", "path")
    return names


# --- Messages and dicts ---

NUMBERS = {"double": "f8", "float": "f4", "char": "u1"} | {f"int{8 * n}": f"i{n}" for n in (1, 2, 4, 8)}
NUMBERS |= {f"uint{8 * n}": f"u{n}" for n in (1, 2, 4, 8)}
PICTURES = (
    ("u1", 1, "mono8 8UC1 bayer_rggb8 bayer_bggr8 bayer_gbrg8 bayer_grbg8"),
    *(("u1", 3, "rgb8 bgr8 8UC3"), ("u1", 4, "rgba8 bgra8 8UC4"), ("u2", 1, "mono16 16UC1"), ("f4", 1, "32FC1")),
)
ENCODINGS = {name: (form, channels) for form, channels, names in PICTURES for name in names.split()}
OF_ARRAYS = {(form, channels): names.split()[0] for form, channels, names in PICTURES}


def message_class(name: str, wrong: Callable[[str], Exception] = LookupError) -> Any:
    """Return the class of `sensor_msgs/msg/Image`, or of `sensor_msgs/Image`."""
    package, _, kind = name.replace("/msg/", "/").partition("/")
    try:
        return getattr(importlib.import_module(f"{package}.msg"), kind)
    except (ImportError, AttributeError, ValueError, TypeError):
        raise wrong(f"there is no message type {name!r}; source the workspace that has it") from None


def parsed(text: str) -> tuple[str, bool, int | None, int | None]:
    """Return the type of items, whether it is a list, its length if fixed, and its limit: `sequence<string<9>, 3>`."""
    if found := re.fullmatch(r"sequence<(.+?)(?:, (\d+))?>", text):
        return found[1], True, None, int(found[2]) if found[2] else None
    if found := re.fullmatch(r"(.+)\[(\d+)\]", text):
        return found[1], True, int(found[2]), None
    if found := re.fullmatch(r"(w?string)<(\d+)>", text):
        return found[1], False, None, int(found[2])
    return text, False, None, None


def is_image(kind: Any) -> bool:
    return kind.__name__ == "Image" and {"encoding", "step"} <= kind.get_fields_and_field_types().keys()


def to_dict(message: Any) -> dict[str, Any]:
    """Return what to store of a message."""
    tree = {name: _stored(text, getattr(message, name)) for name, text in message.get_fields_and_field_types().items()}
    return _picture(tree) if is_image(type(message)) else tree


def _stored(text: str, value: Any) -> Any:
    kind, is_list, *_ = parsed(text)
    if is_list and kind in NUMBERS:
        return np.array(value, NUMBERS[kind])
    if is_list and kind in ("octet", "boolean"):
        return np.array([each[0] if kind == "octet" else each for each in value], "u1" if kind == "octet" else bool)
    if is_list:
        return [_stored(kind, each) for each in value]
    if hasattr(value, "get_fields_and_field_types"):
        return to_dict(value)
    if kind == "octet":
        return value[0]
    # JSON has no NaN: an array of no dimensions keeps it.
    return np.array(value) if isinstance(value, float) and not math.isfinite(value) else value


def _picture(tree: dict[str, Any]) -> dict[str, Any]:
    """Return the fields with the picture as `data`, or as they are if these say something else of it."""
    form, channels = ENCODINGS.get(tree["encoding"], ("", 0))
    if not form or not (tree["height"] and tree["width"]):
        return tree
    dtype = np.dtype((">" if tree["is_bigendian"] else "<") + form)
    row = tree["width"] * channels * dtype.itemsize  # behind it, up to `step`, there may be padding
    if tree["step"] < row or tree["height"] * tree["step"] != len(tree["data"]):
        return tree
    rows = np.ascontiguousarray(tree["data"].reshape(tree["height"], tree["step"])[:, :row])
    shape = (tree["height"], tree["width"], channels)[: 2 + (channels > 1)]
    picture = rows.view(dtype).reshape(shape).astype(dtype.newbyteorder("="))
    return {**tree, "data": turned(tree["encoding"], picture)}


def turned(encoding: str, picture: Any) -> Any:
    """Swap red and blue of a picture whose encoding begins with blue."""
    return picture[:, :, [2, 1, 0, 3][: picture.shape[2]]] if encoding in ("bgr8", "bgra8") else picture


def from_dict(kind: Any, value: Any, path: str) -> Any:
    """Return the message of a value; fields that are missing keep their defaults. Raises ValueError with the path."""
    if is_image(kind) and isinstance(value, np.ndarray):
        value = {"data": value}
    fields, message = kind.get_fields_and_field_types(), kind()
    if not isinstance(value, dict):
        only = next(iter(fields), None)
        if len(fields) != 1 or only != "data":
            raise ValueError(f"{path}: {value!r:.60} is not a dict with the fields {', '.join(fields)}")
        value = {"data": value}  # of std_msgs
    if is_image(kind) and isinstance(value.get("data"), np.ndarray) and value["data"].ndim > 1:
        value = {**value, **_of_picture(value["data"], value.get("encoding"), f"{path}.data")}
    for name, each in value.items():
        if name not in fields:
            raise ValueError(f"{path}: {kind.__name__} has no field {name!r}; it has {', '.join(fields)}")
        try:
            setattr(message, name, _field(fields[name], each, f"{path}.{name}"))
        except (TypeError, OverflowError, AssertionError) as error:
            found = f"{each.dtype}{list(each.shape)}" if isinstance(each, np.ndarray) else f"{each!r:.60}"
            raise ValueError(f"{path}.{name}: expected {fields[name]}, found {found} ({error!s:.200})") from None
    return message


def _field(text: str, value: Any, path: str) -> Any:
    """Return a value as rclpy has it. Everything is checked here: rclpy itself may check nothing, and crash."""
    kind, is_list, length, most = parsed(text)
    if is_list:
        if not isinstance(value, list | tuple | np.ndarray):
            raise TypeError("it is no list")
        if len(value) != (len(value) if length is None else length) or (most is not None and len(value) > most):
            raise ValueError(f"{path}: {len(value)} items in {text}")
        if kind in NUMBERS:
            return _numbers(NUMBERS[kind], value, path, length)
        return [_field(kind, each, f"{path}[{n}]") for n, each in enumerate(value)]
    if "/" in kind:
        return from_dict(message_class(kind), value, path)
    if kind in ("string", "wstring", "boolean"):
        if not isinstance(value, bool | np.bool_ if kind == "boolean" else str):
            raise TypeError(f"it is no {kind}")
        if most is not None and len(value) > most:
            raise ValueError(f"{path}: {len(value)} characters in {text}")
        return bool(value) if kind == "boolean" else value
    if isinstance(value, bool | str):
        raise TypeError("it is no number")
    if kind in ("double", "float"):
        return float(_numbers(NUMBERS[kind], [float(value)], path, 1)[0])
    number = operator.index(value)
    limits = np.iinfo(NUMBERS.get(kind, "u1"))
    if not limits.min <= number <= limits.max:
        raise ValueError(f"{path}: {number} does not fit {kind}")
    return bytes([number]) if kind == "octet" else number


def _numbers(form: str, value: Any, path: str, length: int | None) -> Any:
    """Return numbers as rclpy has them: `array.array`, or numpy's for a fixed length."""
    given = np.asarray(value)
    if given.ndim != 1 or (given.size and given.dtype.kind not in "iuf"):
        raise TypeError("it is no list of numbers")
    with np.errstate(invalid="ignore", over="ignore"):  # what does not fit is refused below
        numbers = given.astype(form)
    is_float = numbers.dtype.kind == "f"  # which loses digits, but does not become infinite
    if not np.array_equal(*((np.isinf(numbers), np.isinf(given)) if is_float else (numbers, given))):
        raise ValueError(f"{path}: some numbers do not fit {numbers.dtype}")
    if length is not None:
        return numbers
    return array.array(numbers.dtype.char.replace("l", "q").replace("L", "Q"), numbers.tobytes())


def _of_picture(picture: Any, encoding: Any, path: str) -> dict[str, Any]:
    form = picture.dtype.str[1:]
    channels = picture.shape[2] if picture.ndim == 3 else 1
    encoding = encoding or OF_ARRAYS.get((form, channels))
    if ENCODINGS.get(encoding) != (form, channels):
        raise ValueError(f"{path}: {picture.dtype}{list(picture.shape)} is no picture in the encoding {encoding}")
    rows = np.ascontiguousarray(turned(encoding, picture), "<" + form)
    sizes = {"height": picture.shape[0], "width": picture.shape[1], "step": rows.strides[0] if rows.size else 0}
    return {**sizes, "encoding": encoding, "is_bigendian": 0, "data": rows.reshape(-1).view(np.uint8)}


# --- The bridge ---


class Bridge:
    """What the entries of a file say, between one ROS node and one server, until `close`."""

    def __init__(self, node: Any, interface: reem.RedisInterface, file: Entry) -> None:
        self.node = node
        self.failed = False
        self._reported: dict[str, set[str]] = {}
        self._closed = threading.Event()
        self._kvs = reem.KeyValueStore(interface)
        # A callback of ROS does not wait for the server, and an outage costs no more than the updates in it.
        self._space = reem.PublishSpace(interface, outage="newest", wait=False, on_error=self._failed)
        self.direct = reem.PublishSpace(interface)
        self._lacking = True  # the dicts that hold the values may have to be made
        self._topics = file["topics"]
        self._due: dict[Pair, bool] = {}  # parameters that may have changed, and whether one side has begun
        self._due_changed = threading.Condition()
        # First all types, so that nothing is passed on by half of a file.
        kinds = [message_class(each["type"], partial(each.wrong, key="type")) for each in self._topics]
        self._parameters = [Pair(self, each) for each in file["parameters"]]
        self.make_parents()
        for entry, kind in zip(self._topics, kinds, strict=True):
            self._begin(entry, kind)
        if self._parameters:
            self._begin_parameters()

    def close(self) -> None:
        self._closed.set()
        with self._due_changed:
            self._due_changed.notify()

    def at(self, path: tuple[str, ...], store: Any = None) -> Any:
        place = self._kvs if store is None else store
        for name in path:
            place = place[name]
        return place

    def report(self, entry: Entry | None, text: str) -> None:
        """Log each problem of an entry once, with its line in the file."""
        where = "" if entry is None else f"{entry.where}: "
        seen = self._reported.setdefault(where, set())
        if text not in seen and len(seen) < MOST_REPORTED:
            seen.add(text)
            logger.warning("%s%s", where, text)

    def make_parents(self) -> None:
        for entry in (*self._topics, *(each.entry for each in self._parameters)):
            for depth in range(1, len(entry["path"])):
                self.at(entry["path"][: depth - 1]).setdefault(entry["path"][depth - 1], {})
        self._lacking = False

    def _failed(self, error: Exception) -> None:
        self._lacking = True  # a server that was restarted without its data has none
        self.report(None, f"a message was not stored: {error}")

    def run(self, target: Callable[..., None], *args: Any) -> None:
        """Run a function for as long as the bridge; its failure ends the bridge, so that it can be started again."""
        try:
            target(*args)
        except Exception as error:
            if not self._closed.is_set():
                logger.exception("the bridge ends: %s", error)
                self.failed = True
                rclpy.try_shutdown()

    def thread(self, *job: Any) -> None:
        threading.Thread(target=self.run, args=job, daemon=True).start()

    def _begin(self, entry: Entry, kind: Any) -> None:
        chosen = {"reliability": "reliable", "durability": "volatile", "depth": 10, **entry["qos"]}
        qos = QoSProfile(
            depth=chosen["depth"],
            reliability=ReliabilityPolicy[chosen["reliability"].upper()],
            durability=DurabilityPolicy[chosen["durability"].upper()],
        )
        if entry["direction"] == "from_ros":
            self.node.create_subscription(kind, entry["topic"], lambda message: self._store(entry, message), qos)
        else:
            publisher = self.node.create_publisher(kind, entry["topic"], qos)
            self.thread(self._pass_on, entry, kind, publisher, chosen)

    def _store(self, entry: Entry, message: Any) -> None:
        try:
            if self._lacking:
                self.make_parents()
            *above, name = entry["path"]
            self.at(tuple(above), self._space)[name] = to_dict(message)
        except (reem.ReemError, RedisError, ValueError) as error:
            self.report(entry, f"a message of {entry['topic']} was not stored: {error}")

    def _pass_on(self, entry: Entry, kind: Any, publisher: Any, chosen: dict[str, Any]) -> None:
        # A command that was there before the bridge is old, unless late subscribers are meant to get it.
        with_old = chosen["durability"] == "transient_local"
        place = self.at(entry["path"])
        for update in place.watch(reem.Last(chosen["depth"]), ttl=entry.get("ttl")):
            if update.silent or update.data is None or (update.initial and not with_old):
                continue
            try:
                publisher.publish(from_dict(kind, update.data, ".".join(entry["path"])))
            except (ValueError, LookupError) as error:
                self.report(entry, f"not passed on to {entry['topic']}: {error}")

    # Parameters. One thread handles the changes of both sides, one after the other.

    def _begin_parameters(self) -> None:
        own = self.node.get_fully_qualified_name()
        pairs = {(each.entry.get("node", own), each.entry["name"]): each for each in self._parameters}

        def on_event(event: Any) -> None:
            for each in (*event.new_parameters, *event.changed_parameters):
                if (pair := pairs.get((event.node, each.name))) is not None:
                    has_begun = each in event.new_parameters
                    pair.reported = None if has_begun else plain(parameter_value_to_python(each.value))
                    self._is_due(pair, has_begun)

        for pair in self._parameters:
            pair.declare()
        self.node.create_subscription(ParameterEvent, "/parameter_events", on_event, qos_profile_parameter_events)
        self.thread(self._work)
        for pair in self._parameters:
            self._is_due(pair, True)
            self.thread(self._follow, pair)

    def _follow(self, pair: Pair) -> None:
        for _ in self.at(pair.entry["path"]).watch():
            self._is_due(pair, False)

    def _is_due(self, pair: Pair, has_begun: bool) -> None:
        with self._due_changed:
            self._due[pair] = has_begun or self._due.get(pair, False)
            self._due_changed.notify()

    def _work(self) -> None:
        while True:
            with self._due_changed:
                self._due_changed.wait_for(lambda: self._due or self._closed.is_set())
                if self._closed.is_set():
                    return
                pair, has_begun = next(iter(self._due.items()))
                del self._due[pair]
            try:
                pair.agree(has_begun)
            except reem.BadInput as error:  # NaN, for example
                self.report(pair.entry, f"the value in ROS was not stored: {error}")
            except (reem.ReemError, RedisError) as error:
                self.report(pair.entry, f"trying again: {error}")
                self._is_due(pair, has_begun)
                self._closed.wait(1)


class Pair:
    """One parameter of ROS and one path, which are to be equal. Where both have changed, what is stored wins."""

    def __init__(self, bridge: Bridge, entry: Entry) -> None:
        self.entry = entry
        self._bridge = bridge
        self.reported: Any = None  # the last change of the parameter of which ROS has notified the bridge
        self._agreed: Any = None  # the value that both had last
        self._client: Any = None  # of the node that has the parameter; None for the bridge's own

    def declare(self) -> None:
        """Declare a parameter of the bridge itself, or find the node that has it."""
        if "node" in self.entry:
            self._client = AsyncParameterClient(self._bridge.node, self.entry["node"])
            return
        value = self._stored()
        value = self.entry.get("default") if value is None else value
        if value is None:
            raise self.entry.wrong(f"nothing is stored at {'.'.join(self.entry['path'])}; give a default")
        try:
            self._bridge.node.declare_parameter(self.entry["name"], value)
        except (TypeError, ValueError) as error:
            raise self.entry.wrong(f"{value!r:.60} cannot be a parameter of ROS ({error})", "default") from None

    def agree(self, has_begun: bool) -> None:
        """Make both equal, as they are now, whatever has changed."""
        if has_begun:  # the bridge or the node: what is stored wins
            self._agreed = None
        in_ros = self._in_ros()
        if in_ros is None:
            return
        stored = self._stored()
        value = float(stored) if isinstance(in_ros, float) and type(stored) is int else stored
        if value is not None and value not in (in_ros, self._agreed):
            refused = self._set(value)
            if refused is None:
                self._agreed = value
            if not refused:  # taken, or no answer
                return
            self._bridge.report(self.entry, f"{self.entry['name']} = {value!r:.60} was refused by ROS: {refused}")
        elif value is not None and in_ros not in (value, self.reported):
            return  # of a node that has begun again, whose event is still to come
        if value != in_ros:
            *above, name = self.entry["path"]
            self._bridge.make_parents()
            self._bridge.at(tuple(above), self._bridge.direct)[name] = in_ros
        self._agreed = in_ros

    def _stored(self) -> Any:
        return plain(self._bridge.at(self.entry["path"]).get())

    def _in_ros(self) -> Any:
        """Return the value in ROS; None if there is none, or the node does not answer."""
        name = self.entry["name"]
        if self._client is None:
            return plain(self._bridge.node.get_parameter(name).value)
        found = self._answer(self._client.get_parameters([name]), "values")
        value = None if found is None else plain(parameter_value_to_python(found[0]))
        if found is not None and value is None:
            self._bridge.report(self.entry, f"{self.entry['node']} has no parameter {name}")
        return value

    def _set(self, value: Any) -> str | None:
        """Return why ROS does not take the value, None if it does; empty if the node does not answer."""
        try:
            parameters = [Parameter(self.entry["name"], value=value)]
        except (TypeError, ValueError, AssertionError) as error:
            return f"it is no parameter of ROS ({error})"
        if self._client is None:
            results = self._bridge.node.set_parameters(parameters)
        elif (results := self._answer(self._client.set_parameters(parameters), "results")) is None:
            return ""
        return None if results[0].successful else results[0].reason or "no reason given"

    def _answer(self, future: Any, field: str) -> Any:
        done = threading.Event()
        future.add_done_callback(lambda _: done.set())
        if not done.wait(TIMEOUT) or future.result() is None:
            self._bridge.report(self.entry, f"{self.entry['node']} does not answer; the bridge waits until it begins")
            return None
        return getattr(future.result(), field)


def plain(value: Any) -> Any:
    """Return arrays as lists."""
    return value.tolist() if hasattr(value, "tolist") else list(value) if isinstance(value, tuple) else value


def main(arguments: list[str] | None = None) -> int:
    logging.basicConfig(format="%(message)s", level=logging.INFO)
    given = sys.argv if arguments is None else ["ros2_bridge.py", *arguments]
    parser = argparse.ArgumentParser(description="Pass topics and parameters between ROS 2 and REEM.")
    parser.add_argument("file", help="what to pass on, as YAML")
    file = parser.parse_args(remove_ros_args(given)[1:]).file
    try:
        found = load(file)
        with reem.RedisInterface(found.get("server", "localhost"), namespace=found.get("namespace", "")) as interface:
            rclpy.init(args=given)
            node = rclpy.create_node("reem_bridge")
            bridge = Bridge(node, interface, found)
            logger.info("%s: %d topics, %d parameters", file, len(found["topics"]), len(found["parameters"]))
            try:
                rclpy.spin(node)
            except (KeyboardInterrupt, ExternalShutdownException):
                pass
            finally:
                bridge.close()
                node.destroy_node()
                rclpy.try_shutdown()
            return int(bridge.failed)
    except (Wrong, reem.ReemError, RedisError) as error:
        print(error, file=sys.stderr)
        return 1


if __name__ == "__main__":
    sys.exit(main())
