"""The two fronts agree: the same names, the same parameters, the same promises in their docstrings."""

import ast
import importlib
import inspect

import pytest

import reem
import reem_async
import reem_async.errors as errors
from reem import legacy, utilities
from reem._twin import for_plain_code

CLASSES = [
    "RedisInterface", "KeyValueStore", "PublishSpace", "SilentSubscriber", "CallbackSubscriber",
    "Parameter", "Writer", "Reader", "Publisher", "accessor", "watch", "mirror", "view", "view_watch", "view_mirror",
]  # fmt: skip
MADE = ("accessor", "watch", "mirror", "view", "view_watch", "view_mirror")

SYNTAX = {
    "__aenter__": {"__enter__"},
    "__aexit__": {"__exit__"},
    "__aiter__": {"__iter__"},
    "__anext__": {"__next__"},
    "aclose": {"close"},
    "delete": {"delete", "__delitem__"},
    "length": {"length", "__len__"},
    "increment": {"increment", "__iadd__"},
    "multiply": {"multiply", "__imul__"},
    "divide": {"divide", "__itruediv__"},
    "extend": {"extend", "__iadd__"},
    "edit": {"edit", "__enter__"},
}
"""What asyncio spells as a method and Python's own syntax spells in the blocking front."""

ONLY_BLOCKING = {
    *("__isub__", "__delitem__", "__len__", "__iadd__", "__imul__", "__itruediv__"),
    *("__enter__", "__exit__", "__iter__", "__next__"),
}


def made(package, name):
    if name not in MADE:
        return getattr(package, name)
    place = package.KeyValueStore(package.RedisInterface("localhost"))["foo"]
    of, _, method = name.rpartition("_")
    if "view" in (of, method):
        place = place.of(int)
    return type(place if method in ("accessor", "view") else getattr(place, method)())


def public(kind):
    return {
        name: value
        for base in reversed(kind.__mro__)
        if base.__module__.startswith("reem")
        for name, value in vars(base).items()
        if not name.startswith("_") or name in SYNTAX or name in ONLY_BLOCKING
    }


def parameters(function):
    return [
        (each.name, each.kind, each.default if each.default is each.empty else repr(each.default))
        for each in inspect.signature(function).parameters.values()
    ]


def summary(thing):
    return (inspect.getdoc(thing) or "").strip().split("\n")[0]


def test_both_packages_export_the_same_names():
    """Each listed once, in `__all__`, and really there."""
    assert sorted(reem.__all__) == sorted(set(reem.__all__))
    assert set(reem.__all__) == set(reem_async.__all__)
    for package in (reem, reem_async):
        assert not [name for name in package.__all__ if not hasattr(package, name)]


@pytest.mark.parametrize("module", ["connection", "datatypes", "ships", "errors", "server", "snapshots", "migration"])
def test_both_packages_have_the_same_documented_modules(module):
    """With the same public names, beside which two modules of `reem` keep those that old programs import."""
    plain, core = (
        set(getattr(importlib.import_module(f"{package}.{module}"), "__all__", ()))
        for package in ("reem", "reem_async")
    )
    old = {*reem.__all__, *legacy.__all__, *utilities.__all__} if module in ("connection", "datatypes") else set()
    assert plain - (old - core) == core


@pytest.mark.parametrize("name", CLASSES)
def test_every_method_has_its_twin(name):
    """Under the same name, or as Python's own syntax."""
    blocking, core = public(made(reem, name)), public(made(reem_async, name))
    missing = [each for each in core if not SYNTAX.get(each, {each}) & set(blocking)]
    assert not missing, f"only asyncio has {missing}"
    spelled = set().union(*(SYNTAX.get(each, {each}) for each in core)) | ONLY_BLOCKING
    assert not set(blocking) - spelled, f"only the blocking front has {set(blocking) - spelled}"


@pytest.mark.parametrize("name", CLASSES)
def test_twins_take_the_same_parameters(name):
    blocking, core = made(reem, name), made(reem_async, name)
    if name not in ("Parameter", *MADE):
        assert parameters(blocking.__init__) == parameters(core.__init__)
    for method in public(core).keys() & public(blocking).keys():
        ours, theirs = getattr(blocking, method), getattr(core, method)
        if callable(ours) and not method.startswith("__"):
            assert parameters(ours) == parameters(theirs), f"{name}.{method}"


@pytest.mark.parametrize("name", CLASSES)
def test_twins_promise_the_same(name):
    """Every public class and method has a docstring, and its first line is that of its twin."""
    blocking, core = made(reem, name), made(reem_async, name)
    assert summary(blocking)
    assert summary(blocking) == for_plain_code(summary(core))
    for method in public(core).keys() & public(blocking).keys():
        if not method.startswith("__"):
            assert summary(getattr(blocking, method)), f"{name}.{method} has no docstring"
            promised = for_plain_code(summary(getattr(core, method)))
            assert summary(getattr(blocking, method)) == promised, f"{name}.{method}"
            said = (getattr(blocking, method).__doc__ or "").replace("asyncio", "")
            assert "async" not in said, f"{name}.{method}"
            assert "await " not in said, f"{name}.{method}"


@pytest.mark.parametrize("name", CLASSES)
def test_nothing_is_a_coroutine_in_the_blocking_front(name):
    kind = made(reem, name)
    assert not [each for each in public(kind) if inspect.iscoroutinefunction(getattr(kind, each))]


@pytest.mark.parametrize("module", ["recording", "snapshots"])
def test_tools_have_the_same_names_and_parameters(module):
    ours, theirs = (importlib.import_module(f"{front}.{module}") for front in ("reem", "reem_async"))
    assert set(ours.__all__) == set(theirs.__all__)
    for name in ours.__all__:
        mine, core = getattr(ours, name), getattr(theirs, name)
        if mine is core:
            continue
        shapes = [
            [(each.name, each.kind, each.default) for each in inspect.signature(it).parameters.values()]
            for it in (mine, core)
        ]
        assert shapes[0] == shapes[1], name
        if inspect.isclass(mine):
            used = {"start", "stop", "wait", "status"} if name == "Recorder" else {*vars(core)}
            assert {each for each in used if not each.startswith("_")} <= {*dir(mine)}, name
        elif name != "describe":  # its blocking form says whose result it returns
            assert mine.__doc__ == core.__doc__, name


def test_type_checkers_know_every_error():
    """They read the list as it is written; `reem` and `reem.errors` export by it."""
    (listed,) = (
        ast.literal_eval(node.value)
        for node in ast.parse(inspect.getsource(errors)).body
        if isinstance(node, ast.Assign) and node.targets[0].id == "__all__"
    )
    kinds = [each for each in vars(errors).values() if inspect.isclass(each) and each.__module__ == errors.__name__]
    assert set(listed) == {kind.__name__ for kind in kinds}


def test_errors_policies_and_ships_are_the_very_same_objects():
    """So that an error raised by one front is caught by the other's name."""
    for name in reem.__all__:
        ours, theirs = getattr(reem, name), getattr(reem_async, name)
        if inspect.isclass(ours) and issubclass(ours, Exception):
            assert ours is theirs, name
    for error in vars(errors).values():
        if inspect.isclass(error) and issubclass(error, Exception) and error.__module__ == errors.__name__:
            assert getattr(reem, error.__name__) is error, "programs cannot name what they catch"
    for name in ("Newest", "Last", "Every", "Update", "SpecialDatatypeShip", "NumpyShip"):
        assert getattr(reem, name) is getattr(reem_async, name)
