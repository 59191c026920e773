"""Tests of everything; `make test` runs those that are not slow."""

import os

# Read when gRPC is loaded. Tests start PostgreSQL as another user, which takes a plain fork: with
# gRPC's threads begun again in the child, that now and then crashed before it became initdb.
os.environ.setdefault("GRPC_ENABLE_FORK_SUPPORT", "0")
