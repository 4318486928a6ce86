"""The bridge to ROS 2: with a real server on REEM's side, and a stub of rclpy's API (rosstub.py) in place of ROS."""

import importlib
import math
import subprocess
import sys
import threading

import numpy as np
import pytest
import rosstub
from conftest import ROOT, eventually, sized

import reem


@pytest.fixture
def graph(monkeypatch):
    graph = rosstub.Graph()
    rosstub.install(monkeypatch, graph)
    yield graph
    graph.is_down.set()


@pytest.fixture
def bridge(graph, monkeypatch):
    """The module of the example, imported with the stub."""
    monkeypatch.syspath_prepend(str(ROOT))
    monkeypatch.delitem(sys.modules, "examples.ros2_bridge", raising=False)
    yield importlib.import_module("examples.ros2_bridge")
    sys.modules.pop("examples.ros2_bridge", None)


def test_without_ros_it_says_what_to_source():
    done = subprocess.run([sys.executable, ROOT / "examples/ros2_bridge.py", "x.yaml"], capture_output=True, text=True)
    assert done.returncode == 1
    assert "No module named 'rclpy'; run this with the Python of ROS 2, after: source" in done.stderr


# --- messages ---


def filled(kind, random):
    """A message whose numbers are at the ends of their ranges, or not finite."""
    message = kind()
    for name, text in kind.FIELDS.items():
        item, length, most = rosstub.split(text)
        count = length or random.integers(0, (most or 4) + 1)
        if item == text:
            values = one(item, random)
        else:
            values = [one(item, random) for _ in range(count)]
            if item in rosstub.CODES:
                code = rosstub.CODES[item]
                values = np.array(values, code) if length else rosstub.array.array(code, values)
        setattr(message, name, values)
    return message


def one(kind, random):
    if "/" in kind:
        return filled(rosstub.MESSAGES[kind], random)
    if kind in ("double", "float"):
        return float(np.float32(random.choice([0.1, -1e30, math.inf, math.nan, 2.0])))
    if kind == "boolean":
        return bool(random.integers(2))
    if kind == "octet":
        return bytes([random.integers(256)])
    if "string" in kind:
        return str(random.choice(["", "é", "$", "abcd"]))
    low, high = rosstub.RANGES[kind.rstrip("0123456789")](int(kind.lstrip("uint") or 8)) if kind != "char" else (0, 255)
    return int(random.choice(np.array([low, high, 0], object)))


def same(one, other):
    if isinstance(one, rosstub.Message):
        return all(same(getattr(one, name), getattr(other, name)) for name in one.FIELDS)
    if isinstance(one, list):
        return len(one) == len(other) and all(map(same, one, other))
    numbers = isinstance(one, float | rosstub.array.array | np.ndarray)
    is_equal = np.array_equal(one, other, equal_nan=True) if numbers else one == other
    return type(one) is type(other) and is_equal


@pytest.mark.parametrize(
    "name", ["test_msgs/All", "sensor_msgs/JointState", "geometry_msgs/Polygon", "std_msgs/String"]
)
def test_messages_are_the_same_after_the_way_through_the_server(kvs, key, bridge, name):
    kind, random = rosstub.MESSAGES[name], np.random.default_rng(1)
    place = key()
    for _ in range(sized(10, 100)):
        message = filled(kind, random)
        kvs[place] = bridge.to_dict(message)
        assert same(message, bridge.from_dict(kind, kvs[place].read(), place))


@pytest.mark.parametrize(
    "encoding", ["mono8", "rgb8", "bgr8", "rgba8", "bgra8", "mono16", "16UC1", "32FC1", "bayer_rggb8"]
)
@pytest.mark.parametrize("padding", [0, 3])
def test_an_image_is_an_array_and_its_message_again(kvs, key, bridge, encoding, padding):
    form, channels = bridge.ENCODINGS[encoding]
    message, row = rosstub.MESSAGES["sensor_msgs/Image"](), 3 * channels * int(form[1])
    data = np.arange(2 * (row + padding), dtype="u1")
    is_big = int(form == "u2" and padding == 3)
    message.height, message.width, message.step, message.encoding = 2, 3, row + padding, encoding
    message.is_bigendian, message.data = is_big, rosstub.array.array("B", data)
    place = key()
    kvs[place] = bridge.to_dict(message)
    picture = kvs[place]["data"].read()
    assert picture.dtype == np.dtype(form)
    assert picture.shape == ((2, 3, channels) if channels > 1 else (2, 3))
    if form == "u1" and channels > 1:
        first = [2, 1, 0, 3] if encoding.startswith("bgr") else [0, 1, 2, 3]
        assert picture[0, 0].tolist() == first[:channels]
    if form == "u2":
        assert picture[0, 0] == (0x0001 if is_big else 0x0100)
    again = bridge.from_dict(type(message), kvs[place].read(), place)
    assert (again.step, again.encoding, again.is_bigendian) == (row, encoding, 0)
    assert np.array_equal(bridge.to_dict(again)["data"], picture)
    if not padding and not is_big:
        assert same(again, message)


def test_an_array_alone_is_an_image_and_a_picture_in_another_encoding_stays_bytes(bridge):
    kind = rosstub.MESSAGES["sensor_msgs/Image"]
    picture = np.arange(24, dtype=np.uint8).reshape(2, 4, 3)
    message = bridge.from_dict(kind, picture, "camera")
    assert (message.encoding, message.height, message.width, message.step) == ("rgb8", 2, 4, 12)
    assert bytes(message.data) == picture.tobytes()
    message.encoding = "yuv422"
    assert bridge.to_dict(message)["data"].shape == (24,)
    assert same(bridge.from_dict(kind, bridge.to_dict(message), "camera"), message)


@pytest.mark.parametrize(
    ("kind", "value", "text"),
    [
        ("geometry_msgs/Twist", {"linear": {"w": 1}}, "p.linear: Vector3 has no field 'w'; it has x, y, z"),
        ("geometry_msgs/Twist", {"linear": {"x": "1"}}, "p.linear.x: expected double, found '1' (it is no number)"),
        ("geometry_msgs/Twist", {"linear": 3}, "p.linear: 3 is not a dict with the fields x, y, z"),
        ("geometry_msgs/Polygon", {"points": [{"x": None}]}, "p.points[0].x: expected double, found None"),
        ("sensor_msgs/JointState", {"name": "a1"}, "p.name: expected sequence<string>, found 'a1' (it is no list)"),
        ("sensor_msgs/JointState", {"name": [1]}, "p.name: expected sequence<string>, found [1] (it is no string)"),
        ("sensor_msgs/JointState", {"position": np.eye(2)}, "found float64[2, 2] (it is no list of numbers)"),
        ("sensor_msgs/Image", {"data": np.zeros((2, 2), complex)}, "p.data: complex128[2, 2] is no picture"),
        ("sensor_msgs/Image", {"data": np.zeros((2, 2)), "encoding": "rgb8"}, "is no picture in the encoding rgb8"),
        ("sensor_msgs/Image", {"height": -1}, "p.height: -1 does not fit uint32"),
        ("test_msgs/All", {"int8s": [300]}, "p.int8s: some numbers do not fit int8"),
        ("test_msgs/All", {"int8s": [0.5]}, "p.int8s: some numbers do not fit int8"),
        ("test_msgs/All", {"double_3": [1.0]}, "p.double_3: 1 items in double[3]"),
        ("test_msgs/All", {"few": [1.0] * 3}, "p.few: 3 items in sequence<double, 2>"),
        ("test_msgs/All", {"short": "hello"}, "p.short: 5 characters in string<4>"),
        ("test_msgs/All", {"a_boolean": 1}, "p.a_boolean: expected boolean, found 1 (it is no boolean)"),
        ("test_msgs/All", {"a_float": 1e39}, "p.a_float: some numbers do not fit float32"),
        ("test_msgs/All", {"floats": [0.0, 1e39]}, "p.floats: some numbers do not fit float32"),
        ("std_msgs/Float64", "far", "p.data: expected double, found 'far' (it is no number)"),
    ],
    ids=str,
)
def test_what_is_no_message_is_refused_with_its_path(bridge, kind, value, text):
    with pytest.raises(ValueError) as caught:
        bridge.from_dict(rosstub.MESSAGES[kind], value, "p")
    assert text in str(caught.value)


# --- the file ---

TWIST = "topics:\n- topic: /cmd\n  type: geometry_msgs/msg/Twist\n  path: cmd\n  direction: to_ros\n"


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("topic: x", "b.yaml:1: unknown key 'topic'; use server, namespace, topics, parameters"),
        ("[1, 2]", "b.yaml: [1, 2] is not a mapping"),
        ("[", "b.yaml"),
        ("topics: [{[a]: 1}]", "b.yaml:1: unknown key \"['a']\"; use topic"),
        (
            TWIST.replace("geometry_msgs", "/geometry_msgs"),
            "b.yaml:3: there is no message type '/geometry_msgs/msg/Twist'",
        ),
        ("topics: [1]", "b.yaml:1: 1 is not a mapping; use topic, type, path, direction, qos, ttl"),
        ("topics:\n- topic: /a\n  type: t\n  path: p", "b.yaml:2: direction is missing"),
        (TWIST.replace("to_ros", "both"), "b.yaml:5: direction is 'both'; use from_ros or to_ros"),
        (TWIST.replace("cmd\n  d", "cmd..x\n  d"), "b.yaml:4: path is 'cmd..x'; use names with dots between"),
        (TWIST + "  qos: {depth: 0}", "b.yaml:6: depth is 0; use at least 1"),
        (TWIST + "  qos: {reliability: good}", "b.yaml:6: reliability is 'good'; use reliable or best_effort"),
        (TWIST + "  qos: fast", "b.yaml:6: qos is 'fast'; use default, sensor_data, latched or a mapping"),
        (TWIST + "  qos: {depth: true}", "b.yaml:6: depth is True, not int"),
        (TWIST + "  ttl: -1", "b.yaml:6: ttl is -1; use seconds over 0, and to_ros only"),
        (TWIST + "  path: other", "b.yaml:6: 'path' is there twice; remove one"),
        (
            TWIST + TWIST[8:].replace("to_ros", "from_ros").replace("/cmd", "/x"),
            "b.yaml:8: path cmd is used at b.yaml:2",
        ),
        (
            TWIST + TWIST[8:].replace("to_ros", "from_ros").replace(" cmd", " c"),
            "topic /cmd goes the other way at b.yaml",
        ),
        (TWIST.replace("Twist", "Twister"), "b.yaml:3: there is no message type 'geometry_msgs/msg/Twister'; source"),
        ("parameters: [{name: a, path: a.b, node: ctl}]", "b.yaml:1: node is 'ctl'; use its full name, such as /ctl"),
        ("parameters:\n- name: a\n  path: nowhere.x", "b.yaml:2: nothing is stored at nowhere.x; give a default"),
        ("topics: [", "b.yaml"),
    ],
    ids=str,
)
def test_an_error_in_the_file_names_its_line(bridge, server_url, tmp_path, capsys, key, text, message):
    file = tmp_path / "b.yaml"
    text = text if text.startswith(("[", "topic: ")) else f"{text}\nnamespace: '{key()}:'\nserver: {server_url}\n"
    file.write_text(text)
    assert bridge.main([str(file)]) == 1
    assert message in capsys.readouterr().err


def test_the_example_file_can_be_used_and_is_in_the_documentation(bridge):
    file = ROOT / "examples/ros2_bridge.yaml"
    assert file.read_text() in (ROOT / "docs/howto/from-ros2.md").read_text()
    found = bridge.load(str(file))
    for each in found["topics"]:
        assert bridge.message_class(each["type"])


# --- the bridge ---


@pytest.fixture
def running(bridge, graph, server_url, tmp_path, key):
    """A function that runs the bridge with a file, and returns the store that it writes to."""
    stores = []

    def run(text, **before):
        namespace = f"{key()}:"
        (tmp_path / "b.yaml").write_text(f"{text}namespace: '{namespace}'\nserver: {server_url}\n")
        codes = []
        thread = threading.Thread(target=lambda: codes.append(bridge.main([str(tmp_path / "b.yaml")])))
        interface = reem.RedisInterface(server_url, namespace=namespace)
        stores.append((thread, interface, codes))
        kvs = reem.KeyValueStore(interface)
        for name, value in before.items():
            kvs[name] = value
        thread.start()
        return kvs

    yield run
    graph.is_down.set()
    for thread, interface, codes in stores:
        thread.join(10)
        kvs = reem.KeyValueStore(interface)
        for name in [*kvs]:
            del kvs[name]
        interface.close()
        assert codes == [0]


TOPICS = """
topics:
- {topic: /joints, type: sensor_msgs/msg/JointState, path: arm.joints, direction: from_ros, qos: sensor_data}
- {topic: /camera, type: sensor_msgs/msg/Image, path: camera, direction: from_ros}
- topic: /cmd
  type: geometry_msgs/msg/Twist
  path: cmd
  direction: to_ros
  qos: {depth: 1}
- {topic: /state, type: std_msgs/msg/String, path: state, direction: to_ros, qos: latched}
"""


def test_topics_go_both_ways(running, graph, caplog, server_url, bridge):
    kvs = running(TOPICS, state="ready", cmd={"linear": {"x": 99}})
    node = rosstub.Node(graph, "robot")
    joints = rosstub.MESSAGES["sensor_msgs/JointState"](name=["a", "b"], position=rosstub.array.array("d", [1, 2]))
    eventually(lambda: "/camera" in getattr(graph.nodes.get("/reem_bridge"), "qos", {}))
    made = graph.nodes["/reem_bridge"]
    assert made.qos["/joints"].reliability is rosstub.ReliabilityPolicy.BEST_EFFORT
    assert (made.qos["/joints"].depth, made.qos["/camera"].depth) == (5, 10)
    # From ROS; after a restart of the server without its data, too.
    publisher = node.create_publisher(type(joints), "/joints", None)
    for _ in range(2):
        publisher.publish(joints)
        eventually(lambda: publisher.publish(joints) or "joints" in kvs.get("arm", {}))
        assert kvs["arm"]["joints"]["position"].read().tolist() == [1.0, 2.0]
        del kvs["arm"]
    kvs["arm"] = "no dict"  # each problem is reported once
    for _ in range(20):
        publisher.publish(joints)
    eventually(lambda: "has no element 'joints'" in caplog.text)
    assert kvs["arm"].read() == "no dict"
    image = bridge.from_dict(rosstub.MESSAGES["sensor_msgs/Image"], np.full((480, 640, 3), 7, np.uint8), "")
    node.create_publisher(type(image), "/camera", None).publish(image)
    eventually(lambda: "camera" in kvs)
    assert caplog.text.count("has no element 'joints'") == 1
    assert kvs["camera"]["data"].read().shape == (480, 640, 3)
    # To ROS: what was stored before goes to late subscribers of a latched topic; wrong values are reported.
    eventually(lambda: [each.data for each in graph.published.get("/state", ())] == ["ready"])
    eventually(lambda: "/cmd" in made.qos)
    kvs["cmd"] = {"linear": {"x": 1}}
    eventually(lambda: graph.published.get("/cmd", [None])[-1])
    assert [each.linear.x for each in graph.published["/cmd"]] == [1.0]  # not the command of before
    for wrong in ({"linear": {"x": "fast"}}, {"linear": {"x": "fast"}}, {"lin": 1}):
        kvs["cmd"] = wrong
    eventually(lambda: "b.yaml:5: not passed on to /cmd: cmd: Twist has no field 'lin'" in caplog.text)
    assert caplog.text.count("b.yaml:5: not passed on to /cmd: cmd.linear.x: expected double, found 'fast'") <= 1
    del kvs["cmd"]
    kvs["cmd"] = {"angular": {"z": 2.0}}
    eventually(lambda: graph.published["/cmd"][-1].angular.z == 2.0)


PARAMETERS = """
parameters:
- {node: /controller, name: gains.kp, path: control.kp}
- {name: speed, path: control.speed, default: 1.0}
- {name: mode, path: control.mode, default: hold}
"""


def test_parameters_go_both_ways(running, graph, caplog):
    controller = rosstub.Node(graph, "controller")
    controller.declare_parameter("gains.kp", 2.0)
    kvs = running(PARAMETERS)
    eventually(lambda: kvs.get("control", {}) == {"kp": 2.0, "speed": 1.0, "mode": "hold"})
    made = graph.nodes["/reem_bridge"]

    def values():
        return {
            "kp": controller.parameters["gains.kp"].value,
            "speed": made.parameters["speed"].value,
            "mode": made.parameters["mode"].value,
        }

    def agree(expected):
        eventually(lambda: values() == kvs["control"].read() == expected)

    controller.set_parameters([rosstub.Parameter("gains.kp", value=3.0)])  # ros2 param set
    made.set_parameters([rosstub.Parameter("speed", value=0.5)])
    agree({"kp": 3.0, "speed": 0.5, "mode": "hold"})
    kvs["control"].update({"kp": 4, "mode": "track"})  # a program of REEM; an int is a float to ROS
    agree({"kp": 4.0, "speed": 0.5, "mode": "track"})
    kvs["control"]["mode"] = 7  # of another type: the value of ROS stays
    agree({"kp": 4.0, "speed": 0.5, "mode": "track"})
    assert "b.yaml:5: mode = 7 was refused by ROS: Wrong parameter type, expected str" in caplog.text
    kvs["control"]["kp"] = {"no": "parameter"}
    agree({"kp": 4.0, "speed": 0.5, "mode": "track"})
    controller.set_parameters([rosstub.Parameter("gains.kp", value=math.nan)])
    eventually(lambda: "b.yaml:3: the value in ROS was not stored: control.kp: nan is not JSON" in caplog.text)
    # Both sides at once, again and again: in the end they agree.
    for number in range(sized(20, 200)):
        controller.set_parameters([rosstub.Parameter("gains.kp", value=float(number))])
        kvs["control"]["kp"] = -float(number)
    eventually(lambda: values()["kp"] == kvs["control"]["kp"].read())
    kvs["control"]["kp"] = 9.0
    agree({"kp": 9.0, "speed": 0.5, "mode": "track"})
    # The node goes and begins again: what is stored wins, whether it was changed meanwhile or not.
    for kp in (10.0, None):
        controller.destroy_node()
        if kp:
            kvs["control"]["kp"] = kp
        controller = rosstub.Node(graph, "controller")
        controller.declare_parameter("gains.kp", 2.0)
        agree({"kp": 10.0, "speed": 0.5, "mode": "track"})
