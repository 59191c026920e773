"""Place recognition: the index of anchor descriptors."""

from magic_server.places.index import DescriptorIndex

__all__ = ["DescriptorIndex"]
