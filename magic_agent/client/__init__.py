"""The typed async client of the service.

    async with MagicClient("localhost:50051") as client:
        await client.register_agent("kitchen", "agent_0", model_id="dinov2", dimension=384)
        receipt = await client.submit_submap(submap)
        async for snapshot in client.watch_corrected_poses("kitchen"):
            ...

Every call has a deadline. Only calls that are idempotent are tried again, and only when the server
cannot be reached; an upload that breaks off goes on where it broke. Failures raise the classes of
`magic_core.errors` that the server raised.
"""

from magic_agent.client.connection import ClientConfig
from magic_agent.client.mapping import MappingCalls
from magic_agent.client.maps import MapCalls
from magic_agent.client.sessions import SessionCalls
from magic_agent.client.uploads import UploadCalls

__all__ = ["ClientConfig", "MagicClient"]


class MagicClient(UploadCalls, MappingCalls, MapCalls, SessionCalls):
    """One connection to a server; every method is safe to call concurrently."""
