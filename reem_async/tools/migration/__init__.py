"""Data of REEM 0.0 and 0.1 into data of today.

    foo                the RedisJSON document, without what is not JSON
    foo&&&&metadata    a second document: which places of foo have ships' values, and the ships' labels
    foo.image          what the ship stored; of an array, a hash of arr, dtype, shape and strides

What is no dict was stored at the entry `%%%%ROOT%%%%` of a dict. `plan/olddata.py` tells such data from new data, and
this package converts it; nothing else knows of it.

    done = await migrate(interface, dry_run=True)
"""

from .convert import Migrated, Migration, migrate

__all__ = ["Migrated", "Migration", "migrate"]
