"""Place recognition: the index of the descriptors of anchors, and of keyframes that have one."""

from magic_server.places.hits import Hit, Place, best_of_each
from magic_server.places.index import DescriptorIndex
from magic_server.places.places import LocalPlaces, Places

__all__ = ["DescriptorIndex", "Hit", "LocalPlaces", "Place", "Places", "best_of_each"]
