"""The live view of a session in the browser: a client of the service like any other."""

__all__: list[str] = []
