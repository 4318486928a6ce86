"""Many robots in one place: a namespace for each, all of them watched at once, and a user for each."""

import asyncio
import contextlib
import re

import numpy as np
import pytest
import redis
import yaml
from clusterkit import raw_of
from conftest import ROOT, aeventually

import reem
import reem_async
from reem_async.errors import BadType
from reem_async.pubsub.monitor import Monitor


@pytest.fixture(params=["server", "cluster"])
def host(request):
    return request.getfixturevalue("server_url" if request.param == "server" else "cluster")


async def robot(stack, host, namespace):
    interface = await stack.enter_async_context(reem_async.RedisInterface(host, namespace=namespace))
    return reem_async.PublishSpace(interface)


async def test_the_same_path_of_all_robots_is_watched_at_once(host, key):
    """Each event says whose it is; other paths and other namespaces are not heard."""
    fleet = key("robots/")
    async with contextlib.AsyncExitStack() as stack:
        robots = {n: await robot(stack, host, f"{fleet}r{n}:") for n in range(5)}
        other = await robot(stack, host, f"{fleet[:-1]}x/r0:")
        for space in (*robots.values(), other):
            await space["battery"].write({"volts": 0.0, "cells": [1, 2]})
        watching = await stack.enter_async_context(reem_async.RedisInterface(host))
        monitor = Monitor(watching, ["battery.volts"], namespaces=f"{fleet}*:")
        await monitor.listen()
        await other["battery"]["volts"].write(9.0)
        for number, space in robots.items():
            await space["battery"]["cells"].append(3)
            await space["battery"]["volts"].write(float(number))
        async with asyncio.timeout(10):
            heard = set()
            while len(heard) < len(robots):
                event = await anext(monitor)
                if event.shown == "battery.volts":  # the first writes may still be on their way to all nodes
                    heard.add((event.namespace, event.shown, event.value, event.gap))
        assert heard == {(f"{fleet}r{n}:", "battery.volts", float(n), False) for n in robots}
        await monitor.close()


async def test_keys_of_the_same_name_are_counted_apart(host, key):
    """One publisher in two namespaces is two sequences, and what is missed of one is not missed of the other."""
    fleet = key("f/")
    async with contextlib.AsyncExitStack() as stack:
        one, two = await robot(stack, host, f"{fleet}a:"), await robot(stack, host, f"{fleet}b:")
        for space in (one, two):
            await space["pose"].write(0)
        watching = await stack.enter_async_context(reem_async.RedisInterface(host))
        monitor = Monitor(watching, namespaces=f"{fleet}?:")
        await monitor.listen()
        for number in range(1, 4):
            await one["pose"].write(number)
            await two["pose"].write(-number)
        async with asyncio.timeout(10):
            events = []
            while len(events) < 6:
                event = await anext(monitor)
                if event.value:  # the first writes may still be on their way to all nodes
                    events.append(event)
        assert not [event for event in events if event.missed or event.gap]
        by_robot = {end: [each.value for each in events if each.namespace.endswith(end)] for end in ("a:", "b:")}
        assert by_robot == {"a:": [1, 2, 3], "b:": [-1, -2, -3]}
        await monitor.close()


@pytest.mark.parametrize("wrong", [3, "robots/{r1}:"])
async def test_what_is_no_glob_of_namespaces_is_refused(server_url, wrong):
    interface = reem_async.RedisInterface(server_url)
    with pytest.raises(BadType, match="namespaces="):
        Monitor(interface, namespaces=wrong)
    await interface.close()


USER = re.search(r"```text\nuser r1 (.*?)```", (ROOT / "docs/fleet.md").read_text(), re.DOTALL)
"""The rights of a robot's user in a cluster, from the documentation."""


@pytest.fixture
def robot_url(cluster):
    rules = [rule for rule in USER[1].replace("\\\n", " ").split() if rule != "#HASH"]
    for node in cluster.nodes:
        with raw_of(node) as raw:
            raw.execute_command("ACL", "SETUSER", "r1", *rules, ">word")
    yield cluster.url.replace("//", "//r1:word@")
    for node in cluster.nodes:
        with raw_of(node) as raw:
            raw.acl_deluser("r1")


async def test_a_user_of_one_namespace_can_do_all_in_it_and_nothing_beside_it(robot_url, cluster):
    """Writing, reading, counting, editing, publishing, following, also while a slot moves."""
    async with reem_async.RedisInterface(robot_url, namespace="robots/r1:") as interface:
        kvs, space = reem_async.KeyValueStore(interface), reem_async.PublishSpace(interface)
        for name in ("a", "b", "c", "d"):
            await space[name].write({"n": 1, "image": np.arange(20)})
            mirror = reem_async.SilentSubscriber(name, interface)
            await mirror.listen()
            await kvs[name]["n"].increment(1)
            async with kvs[name].edit() as value:
                value["n"] += 1
            await space[name]["l"].write([1])
            await space[name]["l"].append(2)
            await aeventually(lambda mirror=mirror: (mirror.value() or {}).get("l") == [1, 2])
            assert (await kvs[name].read())["n"] == 3
            await kvs[name].delete()
    async with reem_async.RedisInterface(robot_url, namespace="robots/r2:") as interface:
        with pytest.raises(redis.exceptions.NoPermissionError):
            await reem_async.KeyValueStore(interface)["a"].write(1)
        with pytest.raises(redis.exceptions.NoPermissionError):
            await reem_async.SilentSubscriber("a", interface).listen()


def test_a_user_who_may_not_ask_for_the_layout_is_told_what_is_missing(robot_url, cluster):
    """By the name that the ACL has for it."""
    for node in cluster.nodes:
        with raw_of(node) as raw:
            raw.execute_command("ACL", "SETUSER", "r1", "-cluster|slots")
    with (
        pytest.raises(redis.exceptions.NoPermissionError, match=r"\+cluster\|slots"),
        reem.RedisInterface(robot_url, namespace="robots/r1:"),
    ):
        pass


@pytest.mark.parametrize(("file", "services"), [("cluster-compose.yaml", 7), ("sentinel-compose.yaml", 5)])
def test_compose_files_can_be_read_and_have_a_password_everywhere(file, services):
    """Docker does not run here; this much can be told without it."""
    made = yaml.safe_load((ROOT / "deploy" / file).read_text())
    assert len(made["services"]) == services
    assert all("REEM_PASSWORD:?" in config["content"] for config in made["configs"].values())
    named = {volume.partition(":")[0] for each in made["services"].values() for volume in each.get("volumes", ())}
    assert named == set(made["volumes"])
