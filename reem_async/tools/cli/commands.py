"""Which commands there are, and where each is."""

from __future__ import annotations

from typing import NamedTuple

__all__ = ["COMMANDS", "Entry"]

# The headings of `reem --help`, in this order.
SERVER, LOOK, CHANGE, LIVE, LOG = "Server", "Look", "Change", "Live", "Record and browse"


class Entry(NamedTuple):
    """What `reem --help` says of one command, and where the command is.

    Attributes:
        name: What the user types.
        module: The module that has it: in this package, or below `reem_async` if it has a dot.
        attribute: Its function, or its typer application if it has subcommands.
        panel: The heading that it stands under.
        help: One line; the whole text is the docstring.
        takes_minus: Its values may begin with a minus sign: unknown options are handed to it as arguments.
    """

    name: str
    module: str
    attribute: str
    panel: str
    help: str
    takes_minus: bool = False

    @property
    def full_module(self) -> str:
        """The full name of the module."""
        return f"{'reem_async' if '.' in self.module else 'reem_async.tools.cli'}.{self.module}"


COMMANDS = (
    Entry("up", "up", "up", SERVER, "Start a private server and keep it up until Ctrl-C."),
    Entry(
        "demo",
        "demo",
        "demo",
        SERVER,
        "Start a simulated robot and show it on a page in the web browser, until Ctrl-C.",
    ),
    Entry("doctor", "doctor", "doctor", SERVER, "Check server, connection and installation, and say what to do."),
    Entry("migrate", "legacy.command", "migrate", SERVER, "Convert what REEM 0.1 or older has stored, in place."),
    Entry("ls", "listing", "ls", LOOK, "List keys with type and size."),
    Entry("tree", "listing", "tree", LOOK, "Show what is below keys; arrays are not fetched."),
    Entry("get", "get", "get", LOOK, "Print a value, or write it to a file."),
    Entry("set", "change", "set_", CHANGE, "Store a value.", takes_minus=True),
    Entry("del", "change", "delete", CHANGE, "Delete a value."),
    Entry("pub", "pub", "pub", CHANGE, "Publish a value, once or at a rate.", takes_minus=True),
    Entry("echo", "echo", "echo", LIVE, "Print changes as they are published or stored."),
    Entry("top", "top", "top", LIVE, "Show what is published: a live table of keys."),
    Entry("hz", "top", "hz", LIVE, "Measure how often paths are published or stored."),
    Entry("bw", "top", "bw", LIVE, "Measure how many bytes are published."),
    Entry("delay", "top", "delay", LIVE, "Measure the time from publishing to receiving."),
    Entry("record", "record", "record", LOG, "Record what is published, and samples, into an MCAP file."),
    Entry("play", "play", "play", LOG, "Publish a recording again, at the recorded pace."),
    Entry("log", "log", "app", LOG, "Look into recordings, and export them."),
    Entry("browse", "browse", "browse", LOG, "Show all keys on a page in the web browser, with a slider for the time."),
    Entry("snapshot", "snapshot", "app", LOG, "Save what a server holds to files, list them, restore them."),
)
