"""Place recognition: the index of anchor descriptors."""

from magic_server.places.index import DescriptorIndex
from magic_server.places.places import LocalPlaces, Places

__all__ = ["DescriptorIndex", "LocalPlaces", "Places"]
