"""The magic command."""
