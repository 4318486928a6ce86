"""Ships carry what is not JSON; the same objects serve both fronts."""

from reem_async.ships import BlobShip, BytesShip, Jpeg, JpegShip, NumpyShip, Png, PngShip, SpecialDatatypeShip

__all__ = ["BlobShip", "BytesShip", "Jpeg", "JpegShip", "NumpyShip", "Png", "PngShip", "SpecialDatatypeShip"]
