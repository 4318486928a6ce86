"""A private, real server inside a program; one object serves both fronts."""

from reem_async.server import EmbeddedServer

__all__ = ["EmbeddedServer"]
