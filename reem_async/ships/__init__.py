"""Ships carry what is not JSON: numpy arrays, bytes, and types of your own."""

from .base import BlobShip, BytesShip, SpecialDatatypeShip
from .numpy import NumpyShip

__all__ = ["BlobShip", "BytesShip", "NumpyShip", "SpecialDatatypeShip"]
