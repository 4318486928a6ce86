"""Paths in URLs and snippets: one text for each path, which leads back to exactly that path."""

from __future__ import annotations

from ...errors import BadKey
from ...plan.paths import Path, check_top_key, parse, parse_suffix, suffix
from ...plan.trees import is_addressable as is_addressable

# Characters.
_LONGEST = 4096


def address(path: Path) -> str:
    """Return the text of a path: `foo.bar[2]`, or `["a.b"].c` where a key needs quotes; "" for the root."""
    return suffix(path).removeprefix(".")


def path_of(text: str) -> Path:
    """Return the path whose address is `text`, or which a user typed.

    Raises:
        BadKey: Not a path, such as `../etc`, or one that is far too long.
    """
    if len(text) > _LONGEST:
        raise BadKey(f"a path of {len(text)} characters is too long; shorten it to {_LONGEST}")
    path = parse_suffix(text if text[0] == "[" else "." + text) if '["' in text else parse(text)
    if path:
        check_top_key(path[0])
    return path


def snippets(path: Path, url: str, namespace: str) -> dict[str, str]:
    """Return Python that reads a path from a server, for both fronts."""
    # As far as a path can lead; the rest is taken out of what was read, in Python.
    reach = next((index for index, key in enumerate(path) if index and not is_addressable(key)), len(path))
    where, below = ("".join([f"[{key!r}]" for key in keys]) for keys in (path[:reach], path[reach:]))
    read = f"kvs{where}.read()"
    awaited = f"(await {read}){below}" if below else f"await {read}"
    interface = f"RedisInterface({url!r}" + (f", namespace={namespace!r})" if namespace else ")")
    return {
        "blocking (reem)": "from reem import KeyValueStore, RedisInterface\n\n"
        f"kvs = KeyValueStore({interface})\nvalue = {read}{below}\n",
        "asyncio (reem_async)": "import asyncio\nfrom reem_async import KeyValueStore, RedisInterface\n\n"
        "async def main():\n"
        f"    async with {interface} as interface:\n"
        f"        kvs = KeyValueStore(interface)\n        return {awaited}\n\n"
        "value = asyncio.run(main())\n",
    }
