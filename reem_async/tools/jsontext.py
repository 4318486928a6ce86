"""Values as JSON text: the one form that the command line prints and the page downloads.

Nothing is lost but the type of an array:

| value | JSON |
|---|---|
| array | nested lists; of a structured array a list of its fields for each item |
| NaN, infinity | NaN, Infinity, -Infinity, as Python's json reads them |
| float16, float32 | the shortest number that is the same float of that size |
| complex | text, such as "(1+2j)" |
| datetime64 | text in ISO 8601 with all digits of its unit, or "NaT" |
| timedelta64 | text of a count and its unit, such as "5 ms", or "NaT" |
| bytes | base64 |
"""

from __future__ import annotations

import base64
import json
from typing import Any

import numpy as np
import orjson


def json_text(value: Any, *, pretty: bool = False) -> str:
    """Return a value as JSON, in one line, or indented if `pretty`; it may contain half of a surrogate pair."""
    plain = _plain(value)
    try:
        text = orjson.dumps(plain, option=orjson.OPT_INDENT_2 if pretty else None).decode()
    except orjson.JSONEncodeError:  # nested very deep, half of a surrogate pair, or a huge int
        text = "null"
    # orjson writes null for NaN and infinity silently. Python's encoder, which names them, is ten times slower.
    if "null" not in text:
        return text
    separators = None if pretty else (",", ":")
    return json.dumps(plain, indent=2 if pretty else None, separators=separators, ensure_ascii=False)


def _plain(value: Any) -> Any:
    """Return a value made of dicts, lists, text, numbers, bools and None."""
    if isinstance(value, dict):
        return {str(key): _plain(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [_plain(item) for item in value]
    if hasattr(value, "dtype"):
        return _listed(np.asarray(value))
    if value is None or isinstance(value, str | int | float):
        return value
    return base64.b64encode(value).decode() if isinstance(value, bytes) else str(value)


def _listed(array: np.ndarray[Any, Any]) -> Any:
    """Return an array as nested lists, one without axes as a single value."""
    kind = array.dtype.kind
    if array.dtype.names is not None:
        return _rows(array)
    if kind == "M":
        # numpy reads other byte orders as the machine's own here. Without a unit it can only be NaT.
        generic = np.datetime_data(array.dtype)[0] == "generic"
        dated = array.astype("M8[s]" if generic else array.dtype.newbyteorder("="))
        return np.datetime_as_string(dated).tolist()
    if kind == "m":
        return _durations(array)
    if kind == "f" and array.itemsize < 8:
        return array.astype(np.str_).astype(np.float64).tolist()
    listed = array.tolist()
    return _plain(listed) if kind in "cSV" else listed


def _rows(array: np.ndarray[Any, Any]) -> Any:
    items = array.reshape(-1)
    rows = np.empty(items.size, object)
    for place, row in enumerate(zip(*[_listed(items[name]) for name in array.dtype.names or ()], strict=True)):
        rows[place] = list(row)
    return rows.reshape(array.shape).tolist()


def _durations(array: np.ndarray[Any, Any]) -> Any:
    unit, step = np.datetime_data(array.dtype)
    ending = "" if unit == "generic" else f" {unit}"
    texts = np.empty(array.shape, object)
    for place, count in np.ndenumerate(array.astype(np.int64)):
        texts[place] = "NaT" if np.isnat(array[place]) else f"{int(count) * step}{ending}"
    return texts.tolist()
