"""Version 1 of the contract: `magicslam.v1.<file>_pb2` and `magicslam.v1.<file>_pb2_grpc`."""
