"""One agent: tracking, mapping, image descriptors, the spool and uplink, and the client.

Import from the modules: `agent.Agent` runs an agent, `slam.LocalSlam` is its engine without a
network, `client.MagicClient` talks to a server.
"""
