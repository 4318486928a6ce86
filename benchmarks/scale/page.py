"""The tables of docs/lab/scale.md, computed from the kept results and put between their markers."""

from __future__ import annotations

import dataclasses
import re
from collections.abc import Callable, Sequence
from pathlib import Path

from . import kinds, replay, spread
from .measure import FOLLOWERS
from .model import Cost, Figures, Robot, Topic, bottleneck, carried, most_followers, on_the_line, robot_load, topic_load
from .results import ROOT, Results, cost, figures
from .servers import SETTINGS
from .text import bits, number, size, table, times

PAGE = ROOT / "docs" / "lab" / "scale.md"

NAMES = {"point": "set point", "packed": "60 kB frame", "frame": "0.92 MB frame"}
BUDGETS = {
    "core": "server core",
    "line_in": "network, received",
    "line_out": "network, sent",
    "memory": "memory",
    "connections": "connections",
}


def measured(found: Results) -> str:
    """What each operation costs, in the three settings."""
    one, three, six = (found["settings"][setting]["cases"] for setting in ("one", "three", "six"))
    rows = []
    for name in one:
        value, operation, *followers = name.split(".")
        what = f"{NAMES[value]}: {operation}" + (f", {followers[0]} followers" if followers else "")
        core = [number(max(0.0, each[name]["core_us"])) for each in (one, three, six)]
        replica = number(max(0.0, six[name]["replica_core_us"])) if operation != "read" else ""
        wire = [f"{size(one[name][way])} / {size(six[name][way])}" for way in ("bytes_in", "bytes_out")]
        sent = size(six[name]["bytes_replica"]) if operation != "read" else ""
        client = f"{number(one[name]['client_us'])} / {number(six[name]['client_us'])}"
        seen = number(one[name]["follower_us"]) if one[name]["follower_us"] else ""
        rows.append([what, *core, replica, *wire, sent, client, seen])
    heads = [
        "operation", "one server", "three primaries", "with replicas", "replica",
        "received", "sent", "to replica", "client", "each follower",
    ]  # fmt: skip
    return table(heads, rows)


def standing(found: Results) -> str:
    """What stands by costs, and what takes memory."""
    here = [found["settings"][setting] for setting in ("one", "three", "six")]
    rows: list[list[str]] = [
        ["an idle server, us of its core per second", *(number(each["idle"]["core_us"]) for each in here)],
        ["a follower that hears nothing, the same", *(number(each["heartbeat"]["core_us"]) for each in here)],
        ["its bytes, received / sent per second",
         *(f"{number(each['heartbeat']['bytes_in'])} / {number(each['heartbeat']['bytes_out'])}" for each in here)],
        ["connections to primaries per follower", *(f"{each['connections']:.1f}" for each in here)],
        ["memory of a connection", *(size(each["memory"]["connection"]) for each in here)],
    ]  # fmt: skip
    for value in FOLLOWERS:
        rows.append([f"memory of a {NAMES[value]}, published", *(size(each["memory"][value]) for each in here)])
        rows.append(
            ["of that, the document (MEMORY USAGE)", *(size(each["memory"][f"{value}.document"]) for each in here)]
        )
        if f"{value}.array" in here[0]["memory"]:
            rows.append(
                ["of that, the array (MEMORY USAGE)", *(size(each["memory"][f"{value}.array"]) for each in here)]
            )
    return table(["", "one server", "three primaries", "with replicas"], rows)


def _terms(topic: Topic, given: Figures) -> list[str]:
    value, beat = given.values[topic.value], given.heartbeat
    load = topic_load(topic, given)
    publish, follower = value.publish(0), value.following(topic.followers)
    fetched = topic.hertz * topic.followers
    sent = publish.bytes_out + publish.bytes_replica
    core = f"{number(publish.core_us)} us + {topic.followers:g} x {number(follower.core_us)} us"
    taken = f"{topic.hertz:g} x {size(publish.bytes_in)} + {number(fetched)} x {size(follower.bytes_in)}"
    given_out = f"{topic.hertz:g} x {size(sent)} + {number(fetched)} x {size(follower.bytes_out)}"
    return [
        f"{topic.name}: {topic.hertz:g} Hz of a {NAMES[topic.value]}, {topic.followers:g} followers",
        f"  core      {topic.hertz:g} x ({core}) + {topic.followers:g} x {number(beat.core_us)} us = {load.core:.4f}",
        f"  received  {taken} + heartbeats; with headers {bits(load.line_in)}",
        f"  sent      {given_out} + heartbeats; with headers {bits(load.line_out)}",
    ]


def _sum(robot: Robot, given: Figures) -> str:
    load = robot_load(robot, given)
    return (
        f"together: {load.core:.4f} core, {bits(load.line_in)} received, {bits(load.line_out)} sent, "
        f"{size(load.memory)}, {load.connections:.0f} connections"
    )


def arithmetic(found: Results) -> str:
    """The arithmetic for both robots on one server, line by line."""
    given = figures(found, "one")
    lines = []
    for robot in kinds.ROBOTS.values():
        lines += [robot.name.upper(), *(line for topic in robot.topics for line in _terms(topic, given))]
        lines += [_sum(robot, given)]
        load = robot_load(robot, given)
        for gigabits in kinds.LINES:
            node = kinds.node(gigabits)
            first = bottleneck(load, node)
            lines.append(
                f"one node, {gigabits} Gbit/s: {number(getattr(node, first))} / {number(getattr(load, first))} = "
                f"{times(getattr(node, first) / getattr(load, first))} robots, by {BUDGETS[first]}"
            )
        lines.append("")
    example = given.values["frame"].following(5).bytes_out
    lines.append(
        f"headers, for example: {example:,.0f} B are {example:,.0f} + 90 x ({example:,.0f} / 1448 + 1)"
        f" = {on_the_line(example) / 8:,.0f} B on the line"
    )
    return "```text\n" + "\n".join(lines) + "\n```\n"


def robots(found: Results) -> str:
    """How many robots fleets of servers carry."""
    rows = []
    for robot in kinds.ROBOTS.values():
        for fleet, (setting, primaries) in kinds.FLEETS.items():
            given = figures(found, setting)
            load = robot_load(robot, given)
            for gigabits in kinds.LINES:
                node = kinds.node(gigabits)
                even = carried(load, node, primaries)
                if primaries == 1:
                    fallen = moved = even
                else:
                    fallen = spread.robots_that_fit(robot, given, node, primaries, moving=False)
                    moved = spread.robots_that_fit(robot, given, node, primaries, moving=True)
                rows.append([
                    robot.name, fleet, f"{gigabits} Gbit/s", f"{even:,}", f"{fallen:,}", f"{moved:,}",
                    BUDGETS[bottleneck(load, node)],
                ])  # fmt: skip
    heads = [
        "robot",
        "servers",
        "line",
        "shared out evenly",
        "as the keys fall",
        "slots moved by weight",
        "first limit",
    ]
    return table(heads, rows)


def remedies(found: Results) -> str:
    """What an arm demands, and how many a node carries, if something is done about it."""
    given = figures(found, "one")
    rows = []
    for what, robot in kinds.REMEDIES.items():
        load = robot_load(robot, given)
        counts = [
            f"{carried(load, kinds.node(line))} ({BUDGETS[bottleneck(load, kinds.node(line))]})" for line in kinds.LINES
        ]
        rows.append([what, f"{load.core:.3f}", bits(load.line_in), bits(load.line_out), *counts])
    return table(
        ["arm with a camera", "core", "received", "sent", *(f"one node, {n} Gbit/s" for n in kinds.LINES)], rows
    )


HOT = (("point", 1000), ("point", 100), ("point", 10), ("packed", 30), ("frame", 30), ("frame", 10))


def hot_key(found: Results) -> str:
    """How many followers one key may have."""
    given = figures(found, "six")
    rows = []
    for value, hertz in HOT:
        row = [f"{NAMES[value]} at {hertz} Hz"]
        for line in kinds.LINES:
            node, topic = kinds.node(line), Topic("hot", value, hertz, 0)
            most = most_followers(topic, given, node)
            load = topic_load(Topic("hot", value, hertz, most + 1), given)
            row.append(f"{most:,} ({BUDGETS[bottleneck(load, node)]})")
        rows.append(row)
    return table(["one key, a node of its own", *(f"followers, {line} Gbit/s" for line in kinds.LINES)], rows)


def _shown(it: spread.Spread) -> str:
    return f"{times(it.fallen)} → {times(it.resharded)} ({it.moved:,})"


def balance(found: Results) -> str:
    """The largest node's load by the mean, as the slots fall and after moving some."""
    given = figures(found, "six")
    arm, base = (spread.cores(kinds.ROBOTS[name], given) for name in ("arm", "base"))
    columns = [
        *(spread.over_sizes(arm, nodes) for nodes in spread.NODES),
        *(spread.over_sizes(base, nodes) for nodes in spread.NODES),
        spread.over_sizes(base, spread.NODES[-1], given),
    ]
    heads = ["robots", *(f"{kind}, {nodes} primaries" for kind in ("arm", "base") for nodes in spread.NODES)]
    heads += [f"base and a shared key, {spread.NODES[-1]} primaries", "the shared key, in cores"]
    rows = [
        [f"{size_:,}", *(_shown(column[place]) for column in columns), number(spread.shared_core(size_, given))]
        for place, size_ in enumerate(spread.SIZES)
    ]
    return table(heads, rows)


def _held(label: str, ran: Results, given: Figures, topics: Sequence[Topic], idle: float) -> list[str]:
    """What the model says of a fleet that ran, at the pace it reached, and what it used."""
    count = ran["robots"]
    core, data = idle, 0.0
    for topic in topics:
        it = dataclasses.replace(topic, hertz=ran["published"][topic.name] / ran["seconds"] / count)
        value = given.values[it.value]
        core += count * topic_load(it, given).core
        each = value.publish(it.followers).bytes_out
        data += count * (it.hertz * each + it.followers * given.heartbeat.bytes_out)
    return [
        label, f"{core:.3f}", f"{ran['core']:.3f}", times(core / ran["core"]),
        size(data), size(ran["bytes_out"]), times(data / ran["bytes_out"]),
    ]  # fmt: skip


def check(found: Results) -> str:
    """What the model says of fleets that ran, and what these used."""
    rows: list[list[str]] = []
    ratios: list[float] = []
    for setting, (label, primaries, _) in SETTINGS.items():
        here, given = found["settings"][setting], figures(found, setting)
        idle = primaries * here["idle"]["core_us"] / 1e6
        what = f"{label}: {replay.ROBOTS} small arms, REEM's clients"
        rows.append(_held(what, here["replay"], given, replay.SMALL.topics, idle))
        silent = dataclasses.replace(given, heartbeat=Cost())
        for ran in here["arms"]:
            what = f"{label}: {ran['robots']} whole arms, plain sockets"
            rows.append(_held(what, ran, silent, kinds.ARM.topics, idle))
            ratios.append(float(rows[-1][3]))
    heads = ["what ran", "core, model", "core, used", "ratio", "sent per second, model", "sent", "ratio"]
    return table(heads, rows) + "\n" + _as_run(found, ratios)


def _as_run(found: Results, ratios: list[float]) -> str:
    """How right the model is for whole arms, and how many a node would carry by what they used."""
    ran = found["settings"]["one"]["arms"][-1]
    each = ran["core"] / ran["robots"]
    fits = kinds.CORE_BUDGET / each
    said = kinds.CORE_BUDGET / robot_load(kinds.ARM, figures(found, "one")).core
    return (
        f"The model says {times(min(ratios))} to {times(max(ratios))} of what whole arms used.\n"
        f"The {ran['robots']} arms that ran on one server used {ran['core']:.3f} / {ran['robots']} = {each:.3f} core "
        f"each. By that, one node would carry {kinds.CORE_BUDGET} / {each:.3f} = {times(fits)} arms;\n"
        f"the model says {times(said)}.\n"
    )


def fresh(found: Results) -> str:
    """What the first seconds of publishers cost a cluster."""
    rows = []
    more = theirs = 0.0
    for setting, others in (("three", 2), ("six", 5)):
        here = found["settings"][setting]
        settled, first = cost(here["cases"]["point.publish.0"]).core_us, here["fresh"]
        more, theirs = max(0.0, first["core_us"] - settled) / others, max(0.0, first["other_core_us"])
        rows.append([f"{others + 1} nodes", *(number(each) for each in (settled, first["core_us"], more, theirs))])
    heads = ["cluster", "settled, us", "first 3 s, us", "more, by other node", "on each other primary, us"]
    return table(heads, rows) + (
        f"\nBy the second row, a publisher of 1000 Hz on a hundred nodes takes 99 x {number(more)} us x 1000 = "
        f"{99 * more / 1e3:.2f} core\nmore of its own node, and {number(theirs)} us x 1000 = {theirs / 1e3:.4f} core "
        f"of each other one. A hundred that start together\ntake {theirs / 10:.2f} core of every node.\n"
    )


def where(found: Results) -> str:
    """When and where it was measured."""
    return (
        f"Measured {found['started'][:10]} in {found['seconds']:.0f} s, medians of {found['rounds']} rounds: "
        f"{found['environment']}.\n"
    )


TABLES: dict[str, Callable[[Results], str]] = {
    "where": where,
    "measured": measured,
    "standing": standing,
    "arithmetic": arithmetic,
    "robots": robots,
    "hot key": hot_key,
    "remedies": remedies,
    "fresh": fresh,
    "balance": balance,
    "check": check,
}


def block(name: str, found: Results) -> str:
    """Return a table with its markers."""
    return f"<!-- {name} -->\n{TABLES[name](found)}<!-- end of {name} -->\n"


def rewrite(found: Results, page: Path = PAGE) -> None:
    """Put all tables into the page."""
    text = page.read_text(encoding="utf-8")
    for name in TABLES:
        wanted = block(name, found)
        pattern = re.compile(rf"<!-- {name} -->\n.*?<!-- end of {name} -->\n", re.DOTALL)
        places = pattern.findall(text)
        if len(places) != 1:
            raise ValueError(f"{page} has {len(places)} places for the table {name!r}, not one")
        text = text.replace(places[0], wanted)
    page.write_text(text, encoding="utf-8")
