"""Every update of many top-level keys: `from reem_async.monitor import Monitor`."""

from .pubsub.monitor import ANNOUNCED, Event, Monitor

__all__ = ["ANNOUNCED", "Event", "Monitor"]
