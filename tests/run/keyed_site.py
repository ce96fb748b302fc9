"""A site whose anchors have keys, for tests of programs: its files, and what a tag receives of it."""

from functools import lru_cache

from msgspec.structs import replace
from node_stage import LAB, PLACE_M

from skyless.core.site import ScheduleSite
from skyless.run import keys
from skyless.sim.evaluation.scenarios import Request, impairments_of
from skyless.sim.listening import TagSpec
from skyless.sim.trajectory import Static
from skyless.sim.world import World
from support.keyed_air import anchors_with_keys, made_keys

FREE = replace(LAB, schedule=ScheduleSite(mode="free", rate_hz=50.0))
KEYS = made_keys(FREE.id, 0.0, 30.0)
"""A first chain, and one that counts from 30 s on."""
FIRST, SECOND = KEYS.chains
OTHER_KEYS = made_keys(FREE.id, 0.0, number=2)
"""Of somebody else for the same site."""


def put(folder, *chains, least_serial=1, seeds=True):
    """Write files of keys as an operator copies them."""
    (folder / keys.SITE_PUBLIC).write_bytes(keys.site_public_bytes(keys.SitePublic(FREE.id, KEYS.public, least_serial)))
    for chain in chains:
        keys.chain_public_file(folder, chain.serial).write_bytes(keys.chain_public_bytes(chain))
        if seeds:
            seed = keys.chain_seed_file(folder, chain.serial)
            seed.touch(0o600)
            seed.write_bytes(keys.seed_bytes(chain))


@lru_cache(maxsize=4)
def tape(seconds=4.0, chains=(FIRST,), seed=1):
    """What a tag at ``PLACE_M`` receives; ``START_UNIX_S`` is the host's time 0."""
    worlds = []
    make = anchors_with_keys(FREE, lambda: worlds[0].now_s, chains)
    world = World(FREE, make, [TagSpec(Static(*PLACE_M[:2]))], impairments_of(Request(FREE), FREE), seed)
    worlds.append(world)
    return tuple(one for broadcast in world.run(seconds) for _, one, _ in broadcast.receptions())
