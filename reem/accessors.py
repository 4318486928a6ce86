"""Where the accessors were in REEM 0.1.x."""

from .legacy import ActiveSubscriberKeyAccessor, KeyAccessor, WriteOnlyKeyAccessor

__all__ = ["ActiveSubscriberKeyAccessor", "KeyAccessor", "WriteOnlyKeyAccessor"]
