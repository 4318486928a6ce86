"""A stub of the part of ROS 2's Python API (rclpy, Jazzy) that examples/ros2_bridge.py uses: all of it in one process.

It stands for ROS alone; REEM and its Redis server are real in the tests. Message classes check what is assigned, as
those of ROS do when `ROS_PYTHON_CHECK_FIELDS=1`. Callbacks run on the thread that spins. What is not here: DDS,
discovery, and the rules by which publishers and subscribers with different QoS do not meet.
"""

import array
import enum
import queue
import re
import sys
import threading
import types
import typing

import numpy as np

CODES = {"double": "d", "float": "f", "char": "B", "int8": "b", "uint8": "B", "int16": "h", "uint16": "H"}
CODES |= {"int32": "i", "uint32": "I", "int64": "q", "uint64": "Q"}
RANGES = {"int": lambda bits: (-(2 ** (bits - 1)), 2 ** (bits - 1) - 1), "uint": lambda bits: (0, 2**bits - 1)}
MESSAGES = {}


class Message:
    FIELDS: typing.ClassVar[dict] = {}

    def __init__(self, **values):
        for name, text in self.FIELDS.items():
            setattr(self, name, default(text))
        for name, value in values.items():
            setattr(self, name, value)

    @classmethod
    def get_fields_and_field_types(cls):
        return dict(cls.FIELDS)

    def __setattr__(self, name, value):
        assert name in self.FIELDS, f"{type(self).__name__} has no {name}"
        check(self.FIELDS[name], value)
        object.__setattr__(self, name, value)

    def __eq__(self, other):
        return type(self) is type(other) and all(
            np.array_equal(getattr(self, name), getattr(other, name)) for name in self.FIELDS
        )


def split(text):
    found = re.fullmatch(r"sequence<(.+?)(?:, (\d+))?>|(.+)\[(\d+)\]", text)
    if found is None:
        return text, None, None
    return found[1] or found[3], found[4] and int(found[4]), found[2] and int(found[2])


def default(text):
    kind, length, _ = split(text)
    if kind != text:
        if kind in CODES:
            return array.array(CODES[kind]) if length is None else np.zeros(length, CODES[kind])
        return [default(kind) for _ in range(length or 0)]
    if "/" in kind:
        return MESSAGES[kind]()
    if kind in ("double", "float"):
        return 0.0
    return {"boolean": False, "octet": b"\x00"}.get(kind, "" if kind.startswith(("string", "wstring")) else 0)


def check(text, value):
    kind, length, most = split(text)
    if kind != text:
        if kind in CODES:
            is_right = isinstance(value, np.ndarray) if length is not None else isinstance(value, array.array)
            assert is_right, f"{text} cannot be a {type(value)}"
            assert (value.dtype.char if length is not None else value.typecode) in (
                CODES[kind],
                {"q": "l", "Q": "L"}.get(CODES[kind]),
            )
        else:
            assert isinstance(value, list)
            for each in value:
                check(kind, each)
        assert length is None or len(value) == length
        assert most is None or len(value) <= most
    elif "/" in kind:
        assert type(value) is MESSAGES[kind], f"{kind} cannot be a {type(value)}"
    elif kind in ("double", "float"):
        assert type(value) is float
    elif kind == "boolean":
        assert type(value) is bool
    elif kind == "octet":
        assert type(value) is bytes
        assert len(value) == 1
    elif kind.startswith(("string", "wstring")):
        assert type(value) is str
        assert "<" not in kind or len(value) <= int(kind.partition("<")[2][:-1])
    else:
        low, high = RANGES[kind.rstrip("0123456789")](int(kind.lstrip("uint")))
        assert type(value) is int
        assert low <= value <= high


def define(package, **kinds):
    module = types.ModuleType(f"{package}.msg")
    for name, fields in kinds.items():
        found = type(name, (Message,), {"FIELDS": fields, "__module__": module.__name__})
        MESSAGES[f"{package}/{name}"] = found
        setattr(module, name, found)
    return {package: types.ModuleType(package), module.__name__: module}


class ReliabilityPolicy(enum.Enum):
    RELIABLE = 1
    BEST_EFFORT = 2


class DurabilityPolicy(enum.Enum):
    TRANSIENT_LOCAL = 1
    VOLATILE = 2


class QoSProfile:
    def __init__(self, *, depth, reliability=None, durability=None):
        self.depth, self.reliability, self.durability = depth, reliability, durability


class Parameter:
    def __init__(self, name, value=None):
        kinds = (bool, int, float, str)
        items = value if isinstance(value, list) else [value]
        if not isinstance(value, (*kinds, list)) or len({type(each) for each in items} - set(kinds) or items[:1]) > 1:
            raise TypeError(f"{value!r} is no parameter")
        if any(not isinstance(each, kinds) for each in items):
            raise TypeError(f"{value!r} is no parameter")
        self.name, self.value = name, value


class Result(types.SimpleNamespace):
    """Results, ParameterEvent, ParameterValue and answers: only their fields count."""


class Future:
    def __init__(self):
        self._done, self._result, self._callbacks = threading.Event(), None, []

    def set_result(self, result):
        self._result = result
        self._done.set()
        for each in self._callbacks:
            each(self)

    def add_done_callback(self, callback):
        self._callbacks.append(callback)
        if self._done.is_set():
            callback(self)

    def result(self):
        return self._result


class Graph:
    """All nodes of a test."""

    def __init__(self):
        self.nodes, self.jobs, self.is_down = {}, queue.SimpleQueue(), threading.Event()
        self.published = {}  # by topic

    def deliver(self, topic, message):
        self.published.setdefault(topic, []).append(message)
        for node in tuple(self.nodes.values()):
            for callback in node.subscriptions.get(topic, ()):
                self.jobs.put(lambda callback=callback: callback(message))

    def spin(self):
        while not self.is_down.is_set():
            try:
                job = self.jobs.get(timeout=0.05)
            except queue.Empty:
                continue
            job()
        raise ExternalShutdownException


class ExternalShutdownException(Exception):
    pass


class Node:
    def __init__(self, graph, name):
        self.graph, self.name = graph, f"/{name}"
        self.subscriptions, self.qos, self.parameters = {}, {}, {}
        graph.nodes[self.name] = self

    def create_subscription(self, kind, topic, callback, qos):
        self.qos[topic] = qos
        self.subscriptions.setdefault(topic, []).append(callback)

    def create_publisher(self, kind, topic, qos):
        self.qos[topic] = qos

        def publish(message):
            assert type(message) is kind
            self.graph.deliver(topic, message)

        return types.SimpleNamespace(publish=publish)

    def declare_parameter(self, name, value):
        self.parameters[name] = Parameter(name, value=value)
        self._event(new_parameters=[Result(name=name, value=Result(python=value))])
        return self.parameters[name]

    def get_parameter(self, name):
        return self.parameters[name]

    def get_fully_qualified_name(self):
        return self.name

    def set_parameters(self, parameters):
        return [self._set(each) for each in parameters]

    def _set(self, parameter):
        before = self.parameters.get(parameter.name)
        if before is None:
            return Result(successful=False, reason="not declared")
        if type(before.value) is not type(parameter.value):
            return Result(successful=False, reason=f"Wrong parameter type, expected {type(before.value).__name__}")
        self.parameters[parameter.name] = parameter
        self._event(changed_parameters=[Result(name=parameter.name, value=Result(python=parameter.value))])
        return Result(successful=True, reason="")

    def _event(self, new_parameters=(), changed_parameters=()):
        event = Result(node=self.name, new_parameters=[*new_parameters], changed_parameters=[*changed_parameters])
        self.graph.deliver("/parameter_events", event)

    def destroy_node(self):
        self.graph.nodes.pop(self.name, None)


class AsyncParameterClient:
    def __init__(self, node, name):
        self.graph, self.name = node.graph, name

    def _ask(self, answer):
        """The answer comes on the thread that spins, if the node is there."""
        future = Future()

        def job():
            if (node := self.graph.nodes.get(self.name)) is not None:
                future.set_result(answer(node))

        self.graph.jobs.put(job)
        return future

    def get_parameters(self, names):
        def answer(node):
            found = [node.parameters.get(name) for name in names]
            return Result(values=[Result(python=None if each is None else each.value) for each in found])

        return self._ask(answer)

    def set_parameters(self, parameters):
        return self._ask(lambda node: Result(results=node.set_parameters(parameters)))


def modules(graph):
    """What `import` finds."""
    found = {
        "rclpy": {
            "init": lambda args=None: None,
            "create_node": lambda name: Node(graph, name),
            "spin": lambda node: graph.spin(),
            "try_shutdown": graph.is_down.set,
        },
        "rclpy.executors": {"ExternalShutdownException": ExternalShutdownException},
        "rclpy.parameter": {"Parameter": Parameter, "parameter_value_to_python": lambda value: value.python},
        "rclpy.parameter_client": {"AsyncParameterClient": AsyncParameterClient},
        "rclpy.qos": {
            "DurabilityPolicy": DurabilityPolicy,
            "QoSProfile": QoSProfile,
            "ReliabilityPolicy": ReliabilityPolicy,
            "qos_profile_parameter_events": QoSProfile(depth=1000),
        },
        "rclpy.utilities": {"remove_ros_args": list},
        "rcl_interfaces": {},
        "rcl_interfaces.msg": {"ParameterEvent": Result},
    }
    made = {}
    for name, members in found.items():
        made[name] = types.ModuleType(name)
        vars(made[name]).update(members)
    header = {"stamp": "builtin_interfaces/Time", "frame_id": "string"}
    vector = {"x": "double", "y": "double", "z": "double"}
    made |= define("builtin_interfaces", Time={"sec": "int32", "nanosec": "uint32"})
    made |= define("std_msgs", Header=header, String={"data": "string"}, Float64={"data": "double"})
    made |= define(
        "geometry_msgs",
        Vector3=vector,
        Point=vector,
        Twist={"linear": "geometry_msgs/Vector3", "angular": "geometry_msgs/Vector3"},
        Polygon={"points": "sequence<geometry_msgs/Point>"},
    )
    numbers = dict.fromkeys(("position", "velocity", "effort"), "sequence<double>")
    image = {"height": "uint32", "width": "uint32", "encoding": "string", "is_bigendian": "uint8", "step": "uint32"}
    made |= define(
        "sensor_msgs",
        JointState={"header": "std_msgs/Header", "name": "sequence<string>", **numbers},
        Image={"header": "std_msgs/Header", **image, "data": "sequence<uint8>"},
    )
    every = {f"{kind}s": f"sequence<{kind}>" for kind in (*CODES, "string", "boolean", "octet")}
    fixed = {f"{kind}_3": f"{kind}[3]" for kind in CODES}
    single = {f"a_{kind}": kind for kind in (*CODES, "string", "wstring", "boolean", "octet") if kind != "char"}
    bounded = {"short": "string<4>", "few": "sequence<double, 2>", "texts": "sequence<string<4>, 2>"}
    made |= define("test_msgs", All={**every, **fixed, **single, **bounded, "points": "geometry_msgs/Point[2]"})
    return made


def install(monkeypatch, graph):
    for name, module in modules(graph).items():
        monkeypatch.setitem(sys.modules, name, module)
