"""Stores of old versions, as these wrote them, and what they hold."""

import json

import numpy as np
from conftest import ROOT

from reem import NumpyShip, SpecialDatatypeShip

VERSIONS = ["reem_0_0_11", "reem_0_1_2", "reem_0_1_3"]

A = np.arange(6.0).reshape(2, 3)


class Pose:
    def __init__(self, x, y):
        self.x, self.y = x, y

    def __eq__(self, other):
        return type(other) is Pose and (self.x, self.y) == (other.x, other.y)

    __hash__ = None


class PoseShip(SpecialDatatypeShip):
    def check_fit(self, value):
        return isinstance(value, Pose)

    def get_label(self):
        return "pose"

    def write(self, key, value, client):
        client.hset(key, "x", str(value.x))
        client.hset(key, "y", str(value.y))

    def read(self, key, client):
        client.hgetall(key)

    def interpret_read(self, responses):
        return Pose(float(responses[0][b"x"]), float(responses[0][b"y"]))


def ships():
    return [PoseShip(), NumpyShip()]


STORED = {
    "plain": {"id": 3, "x": [1, 2.5, None, True, "t"]},
    "mixed": {"image": A.astype("uint8"), "id": 3},
    "whole array": A,
    "number": 5,
    "float": 0.1 + 0.2,
    "text": "hello",
    "list": [1, 2.5, {"a": "b"}],
    "deep": {
        "a": {"b": {"arr": A.T, "n": None, "more": np.arange(3, dtype="int32")}, "c": 1},
        "none": np.zeros((0, 3)),
        "one": np.array(7.5),
        "yes": np.array([True, False]),
    },
    "pose": {"where": Pose(1.5, 2.5), "n": 1},
    "whole pose": Pose(3.0, 4.0),
    "replaced": {"arr": 5, "x": {"z": A * 2}, "n": 1},
    "over": {"a": A},
    "beside": {"sub": A},
    "back": 7,
    "writer": A,
    "published": {"arr": A, "t": 1.25},
    "kinds": {"big": np.arange(3, dtype=">i4"), "text": np.array(["ab", "c"]), "complex": np.array([1 + 2j])},
    "cam": {"image": A + 1},
}
"""What the program that was recorded had stored in the end."""

SINCE_0_1 = {"items": [1, A, 3], "box": {"l": [1, {"m": A}]}}
"""What 0.0.11 could not store."""

SINCE_0_1_3 = {
    "dropped": {"image": A},  # of which an entry was deleted, and with it, by 0.1.3, the document
    "tolerant": {"a": {"b": {"image": A, "n": 1, "more": A * 3}}},
    "tolerant number": 5,
}
"""What only 0.1.3 could store or leave."""

NOT_OLD = {
    "reem_0_0_11": {"plain"},
    "reem_0_1_2": {"plain", "list"},
    "reem_0_1_3": {"plain", "list", "tolerant number"},
}
"""What is stored as it is today."""


def stored(version):
    return {
        **STORED,
        **(SINCE_0_1 if version != "reem_0_0_11" else {}),
        **(SINCE_0_1_3 if version == "reem_0_1_3" else {}),
    }


def recorded(version, only=None, space=""):
    """The commands, with `space` before each key; of some top-level keys, or all."""
    commands = []
    for line in (ROOT / "tests/olddata" / f"{version}.jsonl").read_text(encoding="utf-8").splitlines():
        name, key, *rest = (word.encode("latin-1") for word in json.loads(line))
        top = key.decode().partition("&&&&")[0].partition(".")[0].partition("[")[0]
        if only is None or top in only:
            commands.append((name, space.encode() + key, *rest))
    return commands


def replay(raw, version, only=None, space=""):
    with raw.pipeline(transaction=False) as pipeline:
        for command in recorded(version, only, space):
            pipeline.execute_command(*command)
        pipeline.execute()


def everything(raw):
    """All keys with what they hold; notes of the last update aside."""
    return {
        key: raw.json().get(key) if raw.type(key) == "ReJSON-RL" else raw.dump(key)
        for key in raw.scan_iter()
        if not key.endswith(":last")
    }
