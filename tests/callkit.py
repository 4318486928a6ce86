"""Every kind of call that changes something, for tests that try them all."""

import numpy as np

from reem_async.errors import PathRefused

ZEROS, ONES, LARGE = np.zeros(3), np.ones((2, 2)), np.full(20_000, 7.0)
LIST = [ZEROS, 1, {"a": ZEROS}]


async def edited(at):
    async with at.edit() as value:
        value["a"] = ONES


CALLS = {
    "a number": ({"n": 1}, lambda at: at["n"].write(2), {"n": 2}),
    "an array": ({"a": ZEROS}, lambda at: at["a"].write(ONES), {"a": ONES}),
    "a large array": ({"a": ZEROS}, lambda at: at["a"].write(LARGE), {"a": LARGE}),
    "a number for an array": ({"a": ZEROS, "b": ZEROS}, lambda at: at["a"].write(1), {"a": 1, "b": ZEROS}),
    "an array for a number": ({"a": 1}, lambda at: at["a"].write(ONES), {"a": ONES}),
    "all": ({"a": ZEROS}, lambda at: at.write({"b": ONES}), {"b": ONES}),
    "an array as an item": (LIST, lambda at: at[0].write(ONES), [ONES, *LIST[1:]]),
    "a dict as an item": (LIST, lambda at: at[2].write({"a": ONES}), [*LIST[:2], {"a": ONES}]),
    "a large item": (LIST, lambda at: at[0].write(LARGE), [LARGE, *LIST[1:]]),
    "an appended number": (LIST, lambda at: at.append(5), [*LIST, 5]),
    "an appended array": (LIST, lambda at: at.append(ONES), [*LIST, ONES]),
    "several appended": (LIST, lambda at: at.extend([ONES, 5]), [*LIST, ONES, 5]),
    "a deleted item": (LIST, lambda at: at[0].delete(), LIST[1:]),
    "a deleted array": ({"a": ZEROS, "n": 1}, lambda at: at["a"].delete(), {"n": 1}),
    "a deleted key": ({"a": ZEROS}, lambda at: at.delete(), None),
    "an int added to": ({"n": 1}, lambda at: at["n"].increment(2), {"n": 3}),
    "a float added to": ({"n": 0.1}, lambda at: at["n"].increment(0.2), {"n": 0.1 + 0.2}),
    "a division": ({"n": 1}, lambda at: at["n"].divide(4), {"n": 0.25}),
    "a write below a number": ({"n": 1, "a": ZEROS}, lambda at: at["n"]["x"].write(1), PathRefused),
    "an array below a number": ({"n": 1, "a": ZEROS}, lambda at: at["n"]["x"].write(ONES), PathRefused),
    "an edit": ({"a": ZEROS, "n": 1}, edited, {"a": ONES, "n": 1}),
}
"""What is there, a call, and what is there afterwards, or the error it raises."""
