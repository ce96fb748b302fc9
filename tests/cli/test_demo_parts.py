"""What the demo does when a part of it fails."""

import asyncio

import pytest

from skyless.cli.nodes.demo import _either


def test_a_part_of_the_demo_that_fails_ends_it():
    async def fail():
        raise RuntimeError("the part")

    async def run():
        site = asyncio.ensure_future(asyncio.sleep(60.0))
        try:
            await _either(site, fail())
        finally:
            site.cancel()

    with pytest.raises(RuntimeError, match="the part"):
        asyncio.run(run())
