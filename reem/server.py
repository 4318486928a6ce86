"""A private, real server or cluster inside a program; one object serves both fronts."""

from reem_async.server import EmbeddedCluster, EmbeddedServer

__all__ = ["EmbeddedCluster", "EmbeddedServer"]
