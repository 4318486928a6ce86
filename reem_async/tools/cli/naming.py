"""A user's ship, named on the command line."""

from __future__ import annotations

import importlib
import os
import sys

from reem_async.errors import BadType, BadValue
from reem_async.plan.paths import shorten
from reem_async.ships.base import SpecialDatatypeShip

__all__ = ["ship_named"]


def ship_named(text: str) -> SpecialDatatypeShip:
    """Return the ship `MODULE:NAME`, a class that is made without arguments or a ship; imports the module.

    Modules in the current directory are found, as they are by `python -m`.

    Raises:
        BadValue: There is none.
        BadType: It is no ship.
    """
    module, colon, name = text.partition(":")
    if not (module and colon and name):
        raise BadValue(f"{shorten(text)} does not name a ship; write it like my_ships:PoseShip")
    if os.getcwd() not in sys.path:
        sys.path.insert(0, os.getcwd())
    try:
        thing = importlib.import_module(module)
        for part in name.split("."):
            thing = getattr(thing, part)
        ship = thing() if isinstance(thing, type) else thing
    except Exception as error:  # whatever the user's module does when it is imported
        raise BadValue(f"the ship {text} cannot be made: {type(error).__name__}: {error}") from error
    if not isinstance(ship, SpecialDatatypeShip):
        raise BadType(f"{text} is {shorten(ship)}, which is no SpecialDatatypeShip")
    return ship
