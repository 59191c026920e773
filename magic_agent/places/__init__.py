"""Image descriptors for place recognition: encoders behind one protocol, run by ONNX Runtime."""

from magic_agent.places.model import DescriptorModel, load_descriptor_model
from magic_agent.places.preprocessing import Preprocessing

__all__ = ["DescriptorModel", "Preprocessing", "load_descriptor_model"]
