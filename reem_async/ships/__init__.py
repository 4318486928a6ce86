"""Ships carry what is not JSON: numpy arrays, bytes, and types of your own."""

from .base import FieldShip, SpecialDatatypeShip
from .bytes import BytesShip
from .numpy import NumpyShip

__all__ = ["BytesShip", "FieldShip", "NumpyShip", "SpecialDatatypeShip"]
