"""What the demo does when a part of it fails."""

import asyncio

import pytest

from skyless.cli.nodes.demo import _either


async def test_a_part_of_the_demo_that_fails_ends_it():
    async def fail():
        raise RuntimeError("the part")

    site = asyncio.ensure_future(asyncio.sleep(60.0))
    with pytest.raises(RuntimeError, match="the part"):
        await _either(site, fail())
    site.cancel()
