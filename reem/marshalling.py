"""Where ships were, as marshallers, in REEM 0.1.x."""

from .legacy import NumpyMarshaller, SpecialDatatypeMarshaller, TolerantKeyValueStore

__all__ = ["NumpyMarshaller", "SpecialDatatypeMarshaller", "TolerantKeyValueStore"]
