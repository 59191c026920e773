"""What agents and server share: geometry, Gaussians, rendering, data, evaluation and the wire.

Import from the sub-packages; only `wire` knows the network.
"""
