"""Ships carry what is not JSON: numpy arrays, bytes, compressed pictures, and types of your own."""

from .base import BlobShip, BytesShip, SpecialDatatypeShip
from .images import Jpeg, JpegShip, Png, PngShip
from .numpy import NumpyShip

__all__ = ["BlobShip", "BytesShip", "Jpeg", "JpegShip", "NumpyShip", "Png", "PngShip", "SpecialDatatypeShip"]
