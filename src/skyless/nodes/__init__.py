"""The programs of a running site, asyncio around the protocol machines."""
