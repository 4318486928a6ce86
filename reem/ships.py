"""Ships carry what is not JSON; the same objects serve both fronts."""

from reem_async.ships import BlobShip, BytesShip, NumpyShip, SpecialDatatypeShip

__all__ = ["BlobShip", "BytesShip", "NumpyShip", "SpecialDatatypeShip"]
