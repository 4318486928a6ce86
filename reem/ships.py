"""Ships carry what is not JSON; the same objects serve both fronts."""

from reem_async.ships import BytesShip, FieldShip, NumpyShip, SpecialDatatypeShip

__all__ = ["BytesShip", "FieldShip", "NumpyShip", "SpecialDatatypeShip"]
