"""Several changes in one transaction."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from ..errors import BadType, RedisError, ReemError
from . import Plan, Reply
from .changes import Change
from .paths import show
from .replies import full
from .shapes import ShapeCache
from .writes import change, is_watched

__all__ = ["together"]


def together(changes: Sequence[Change], cache: ShapeCache) -> Plan:
    """Plan changes of entries of one dict in one transaction, and after it what follows from each.

    They are applied all or not at all: what the server refuses one for, the dict that is not there, goes for each.

    Raises:
        BadType: An entry is a list item's, with arrays that may have moved: only one at a time can be watched.
    """
    # A change that is watched begins with a look, and two looks cannot share one transaction.
    for each in changes:
        if is_watched(each, cache):
            raise BadType(
                f"{show(full(each.keys, each.path))}: in a list that holds arrays, or counted from its end, keys "
                "cannot be set together; write them one by one, or use edit()"
            )
    plans = [change(each, cache) for each in changes]

    def decode(replies: Sequence[Reply]) -> Any:
        start, outcomes = 0, []
        for plan in plans:
            mine = replies[start : start + len(plan.commands)]
            start += len(plan.commands)
            outcomes.append(_decoded(plan, mine))
        return _each(outcomes)

    return Plan([command for plan in plans for command in plan.commands], decode, atomic=True)


def _decoded(plan: Plan, replies: Sequence[Reply]) -> Any:
    """Return what a part of a transaction comes to: its result, the next plan, or an error."""
    try:
        return plan.decode(replies)
    except (ReemError, RedisError) as error:
        return error


def _each(outcomes: list[Any]) -> Any:
    """Go on with each outcome that is a plan; raises the first error once all of them have been seen to."""
    for number, outcome in enumerate(outcomes):
        # One after the other: each may need the connection for itself, and the next starts from what this one left.
        if isinstance(outcome, Plan):

            def decode(replies: Sequence[Reply] | None, number: int = number, plan: Plan = outcome) -> Any:
                return _each([*outcomes[:number], _decoded(plan, replies), *outcomes[number + 1 :]])  # type: ignore[arg-type]

            return outcome._replace(decode=decode)
    for outcome in outcomes:
        if isinstance(outcome, Exception):
            raise outcome
    return None
