"""Where the tolerant store was in REEM 0.1.3."""

from .legacy import TolerantKeyValueStore, TolerantKVSVar, TolerantKVSVarSubkey

__all__ = ["TolerantKVSVar", "TolerantKVSVarSubkey", "TolerantKeyValueStore"]
