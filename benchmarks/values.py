"""The values that are written and read, built alike in every process from a short description."""

import json
import time
from typing import Any

import numpy as np

Spec = dict[str, Any]

TEXT = "A" * 100
FRAME_SHAPE = (640, 480, 3)
PIXELS = {"frame": "float64", "image": "uint8"}
"""What pixels are made of, by payload: 7.4 MB and 0.92 MB of them."""
ARRAYS = {"scan": ((2560,), "float32"), **{payload: (FRAME_SHAPE, dtype) for payload, dtype in PIXELS.items()}}
"""Shape and dtype of the array in a message, by payload. The scan has 10 KB."""
FIELDS = {"state": {"q": [0.1234567, -1.2345678, 0.5, 1.57079633, -0.25, 3.1415]}}
"""What a message without an array has beside its stamp: with it, a state is a JSON text of 100 bytes."""


def copies(count: int, data: dict[str, Any]) -> dict[str, Any]:
    """One flat dictionary holding `data` over and over, as in the manual's listings."""
    return {f"copy_{index}_{key}": value for index in range(count) for key, value in data.items()}


def nested(levels: int, data: dict[str, Any]) -> dict[str, Any]:
    """Bury `data` below `levels` dictionaries of one key each."""
    for level in reversed(range(levels)):
        data = {f"sub_{level}": data}
    return data


def random_array(shape: list[int]) -> np.ndarray[Any, Any]:
    """A float64 array that no compressor could shrink."""
    return np.random.default_rng(1).random(shape)


def picture(payload: str) -> np.ndarray[Any, Any]:
    """A frame that no compressor could shrink."""
    shape, dtype = ARRAYS[payload]
    if dtype == "uint8":
        return np.random.default_rng(1).integers(0, 256, shape, np.uint8)
    return random_array(list(shape)).astype(dtype, copy=False)


def message(payload: str, **fields: Any) -> dict[str, Any]:
    """A message stamped now, without its array."""
    return {"timestamp": time.monotonic_ns(), **FIELDS.get(payload, {}), **fields}


def complete(payload: str, data: Any) -> bool:
    """Whether an array as it is sent, or received as bytes, has the payload's shape."""
    shape, dtype = ARRAYS[payload]
    found = data if isinstance(data, np.ndarray) else np.frombuffer(data, dtype).reshape(shape)
    return found.shape == shape


def build(spec: Spec) -> Any:
    """The value a description stands for."""
    kind = spec["kind"]
    if kind == "small":
        return {"number": 1, "string": "REEM"}
    if kind == "strings":
        return copies(spec["count"], {"single_key": TEXT})
    if kind == "floats":
        return {f"joint_{index}": value for index, value in enumerate(random_array([spec["count"]]).tolist())}
    if kind == "arrays":
        return copies(spec["count"], {"single_key": random_array([3, 4])})
    if kind == "array":
        return random_array(spec["shape"])
    if kind == "bytes":
        return random_array([max(1, spec["count"] // 8)])
    if kind == "pottery":
        return nested(5, copies(100, {"single_key": TEXT, "nested_data": {"subkey": TEXT}}))
    raise ValueError(f"no value of kind {kind!r}")


def below(value: Any, path: list[str]) -> Any:
    """The part of `value` at `path`."""
    for key in path:
        value = value[key]
    return value


def same(found: Any, expected: Any) -> bool:
    """Whether a contender read what was written; raw bytes are compared as what they encode."""
    if isinstance(found, bytes | bytearray) and isinstance(expected, np.ndarray):
        return bytes(found) == expected.tobytes()
    if isinstance(found, bytes | bytearray):
        return same(json.loads(found), expected)
    if isinstance(expected, np.ndarray):
        return isinstance(found, np.ndarray) and bool(np.array_equal(found, expected))
    if isinstance(expected, dict):
        return (
            isinstance(found, dict)
            and found.keys() == expected.keys()
            and all(same(found[key], expected[key]) for key in expected)
        )
    if isinstance(expected, float):
        # An older client may lose the last digit; that is no reason to leave it out of a race.
        return bool(np.isclose(found, expected, rtol=1e-14))
    return bool(found == expected)
