"""Faults on purpose: servers that are killed, networks that fail. Each module runs by itself."""
