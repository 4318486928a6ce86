"""The embedded server and cluster: private, real, ended with the program."""

from .cluster import EmbeddedCluster
from .embedded import EmbeddedServer

__all__ = ["EmbeddedCluster", "EmbeddedServer"]
