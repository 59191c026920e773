"""The contract of magic-slam, generated from the .proto files beside it."""
