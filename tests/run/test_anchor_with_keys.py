"""The anchor's program with keys: codes on the air, files that change while it runs, and what it logs."""

import asyncio
import re

import pytest
from keyed_site import FIRST, FREE, KEYS, OTHER_KEYS, SECOND, put
from msgspec.structs import replace
from node_stage import FakeRadio, played

from skyless.cli.main import main
from skyless.core.air.beacon import decode
from skyless.core.air.frame import Reception
from skyless.core.anchor import Anchor
from skyless.core.errors import SkylessError
from skyless.core.keys.authentication import BeaconAuthentication
from skyless.core.keys.fault import Fault
from skyless.core.site import UnplacedAnchor, site_digest
from skyless.core.ticks import TICK_S, difference
from skyless.radio.interface import Restarted
from skyless.run import keys as key_files
from skyless.run.anchor import AnchorNode, Anchors, health_of
from skyless.run.mqtt.messages import Counters, PlacementMessage
from support.keyed_air import START_UNIX_S
from support.mqtt_brokers import stopped

BEGIN_S = 1000.0
"""The first instant of the loop, at which ``START_UNIX_S`` is the time."""


@pytest.fixture
def clock(monkeypatch):
    """The host's clocks are the loop's."""

    def loop_s():
        return asyncio.get_running_loop().time() - BEGIN_S

    monkeypatch.setattr("time.time", lambda: START_UNIX_S + loop_s())
    monkeypatch.setattr("time.monotonic", loop_s)


@pytest.fixture
def keys_folder(tmp_path):
    """A folder with the files of the first chain."""
    put(tmp_path, FIRST)
    return tmp_path


class Stage:
    """Anchors of the site in a jumping loop."""

    def __init__(self, folder, *names, environment=None):
        self.said = []
        keys = key_files.AnchorKeys(folder, FREE.id, self.said.append, environment or {})
        self.radios = [FakeRadio(name) for name in names or ("1",)]
        self.anchors = Anchors(FREE, self.radios, None, self.said.append, simulated=lambda: True, keys=keys)
        self.node = self.anchors.nodes[0]

    async def __aenter__(self):
        self._task = asyncio.ensure_future(self.anchors.run())
        await asyncio.sleep(0)
        for radio, node in zip(self.radios, self.anchors.nodes, strict=True):
            radio.sends = True
            node.on_event(Restarted())
        return self

    async def __aexit__(self, *_):
        await stopped(self._task)

    def frames(self):
        return [decode(transmission.frame) for _, transmission in self.radios[0].transmissions]

    def health(self):
        now_s = asyncio.get_running_loop().time() - BEGIN_S
        return health_of(self.node, Counters(0, 0, 0), START_UNIX_S + now_s, now_s)


@played
async def test_frames_carry_codes_and_other_chains_are_used_without_a_restart(keys_folder, clock):
    async with Stage(keys_folder) as stage:
        await asyncio.sleep(5.0)
        assert all(frame.authentication is not None for frame in stage.frames())
        health = stage.health()
        assert (health.chain, health.code_fault, health.faults) == (1, None, {})
        ends_s = health.chain_ends_unix_s
        put(keys_folder, SECOND)
        await asyncio.sleep(10.0)
        assert stage.health().chain == 1
        assert stage.health().chain_ends_unix_s >= ends_s
        await asyncio.sleep(20.0)
        assert (stage.health().chain, stage.health().code_fault) == (2, None)
        assert all(frame.authentication is not None for frame in stage.frames())
        codes = [line for line in stage.said if "codes" in line]
        assert codes == [f"anchor 1: beacons carry codes of key chain {serial}" for serial in (1, 2)]
        other, faults = BeaconAuthentication(KEYS.chains), set()
        for sent_s, transmission in stage.radios[0].transmissions:
            ahead_s = difference(transmission.tx_ticks, stage.radios[0].ticks_at(sent_s)) * TICK_S
            other.set_time(transmission.tx_ticks, START_UNIX_S + sent_s - BEGIN_S + ahead_s)
            beacon = decode(transmission.frame)
            faults.add(other.fault_of(beacon, Reception(transmission.frame, transmission.tx_ticks)))
        assert faults == {None}


@played
async def test_several_anchors_share_the_files(keys_folder, clock):
    async with Stage(keys_folder, "1", "2", "3") as stage:
        await asyncio.sleep(1.5)
        assert {node.authentication.fault() for node in stage.anchors.nodes} == {None}
        assert len({id(node.authentication) for node in stage.anchors.nodes}) == 3


@played
async def test_files_that_are_copied_at_the_moment_change_nothing(keys_folder, clock):
    async with Stage(keys_folder) as stage:
        await asyncio.sleep(4.0)
        put(keys_folder, SECOND)
        file = key_files.chain_public_file(keys_folder, 2)
        whole = file.read_bytes()
        file.write_bytes(whole[:-9])
        await asyncio.sleep(10.0)
        said = [line for line in stage.said if line.startswith("keys: the earlier ones stay in use:")]
        assert len(said) == 1
        assert "chain-2.public" in said[0]
        assert [chain.serial for chain in stage.anchors._keys.chains] == [1]
        file.write_bytes(whole)
        await asyncio.sleep(4.0)
        assert [chain.serial for chain in stage.anchors._keys.chains] == [1, 2]
        assert stage.health().code_fault is None


def test_a_chain_whose_seed_is_still_to_come_is_named(keys_folder):
    said = []
    keys = key_files.AnchorKeys(keys_folder, FREE.id, said.append, {})
    put(keys_folder, SECOND, seeds=False)
    assert not keys.update()
    assert said == [f"keys: chain 2 has no seed in {keys_folder}; chain 1 stays in use"]
    seed = key_files.chain_seed_file(keys_folder, 2)
    seed.touch(0o600)
    seed.write_bytes(key_files.seed_bytes(SECOND))
    assert keys.update()
    assert not keys.update()


def test_seeds_of_the_environment(tmp_path):
    put(tmp_path, FIRST, seeds=False)
    keys = key_files.AnchorKeys(tmp_path, FREE.id, print, {key_files.SEEDS_VARIABLE: f"1:{FIRST.seed.hex()}"})
    assert keys.chains == (FIRST,)
    with pytest.raises(SkylessError, match=r"chain-1\.seed is missing"):
        key_files.AnchorKeys(tmp_path, FREE.id, print, {})


def test_the_end_of_the_last_chain_is_logged_once_a_day(keys_folder):
    said = []
    keys = key_files.AnchorKeys(keys_folder, FREE.id, said.append, {})
    day_s = 86_400.0
    keys.warn(keys.ends_s - 61.0 * day_s)
    assert said == []
    for moment_s in (-2.5 * day_s, -2.4 * day_s, -1.5 * day_s, -10.0, 10.0, 20.0):
        keys.warn(keys.ends_s + moment_s)
    what = ["ends in 2 days", "ends in 1 days", "ends within a day", "has ended"]
    assert len(said) == 4
    assert all(words in line for words, line in zip(what, said, strict=True))


@played
async def test_an_anchor_whose_chain_has_not_begun_says_so_and_sends_without_codes(tmp_path, clock):
    put(tmp_path, SECOND)

    async with Stage(tmp_path) as stage:
        await asyncio.sleep(3.0)
        assert {frame.authentication for frame in stage.frames()} == {None}
        assert (stage.health().chain, stage.health().code_fault) == (None, "no-chain")
        assert "anchor 1: beacons carry no codes: no key chain counts now (skyless site keys show)" in stage.said


def reported(faults, accepted_s=float("-inf")):
    """Lines of an anchor whose others have these faults for ten seconds."""
    said = []
    authentication = BeaconAuthentication(KEYS.chains)
    report = key_files.AnchorReport(1, said.append)
    for now_s in range(10):
        unix_s = START_UNIX_S + now_s
        authentication.set_time(0, unix_s)
        authentication.faults = {anchor: (fault, unix_s) for anchor, fault in faults.items()}
        report.update(authentication, 1, max(accepted_s, -100.0) if accepted_s < 0 else now_s, unix_s, float(now_s))
    return said[1:]


def test_an_anchor_that_accepts_nobody_suspects_itself():
    faults = {2: Fault.BAD_CODE, 3: Fault.BAD_CODE}
    assert reported(faults) == [
        "anchor 1: no other anchor's code fits: the own seed or this host's clock is probably wrong"
    ]


def test_another_anchor_that_is_refused_is_named():
    (line,) = reported({2: Fault.BAD_CODE}, accepted_s=1.0)
    assert line.startswith("anchor 1: beacons of anchor 2 are not accepted: their codes are wrong")


def test_lines_of_faults_come_once_and_are_few():
    said = []
    lines = key_files.KeyLines("x", said.append)
    for now_s in range(60):
        lines.update(dict.fromkeys(range(100), Fault.BAD_CODE) if now_s < 20 else {}, float(now_s))
    assert len(said) == 2 * key_files.MAX_NAMED
    assert sum("was refused for" in line for line in said) == key_files.MAX_NAMED
    lines.update({1: Fault.LATE}, 100.0)
    lines.update({}, 100.0 + key_files.LASTING_S)
    lines.update({}, 100.0 + 2.0 * key_files.CALM_S)
    assert len(said) == 2 * key_files.MAX_NAMED


@pytest.mark.parametrize(
    ("case", "words"),
    [
        ("master", 'has schedule.mode "master", whose beacons carry no codes; it should be free'),
        ("foreign", "is of site 1; it should be of site 300"),
        ("none", "is no folder"),
    ],
)
def test_wrong_keys_are_refused_before_anything_runs(tmp_path, capsys, complaint, case, words):
    site = tmp_path / "hall.toml"
    size = ["--width", "20", "--depth", "20", "--site-id", "300"]
    assert main(["site", "new", str(site), *size, *(("--paper",) if case == "master" else ())]) == 0
    put(tmp_path, FIRST)
    folder = tmp_path / "none" if case == "none" else tmp_path
    capsys.readouterr()
    assert words in complaint("anchor", "1", "--site", site, "--keys", folder, "--mqtt", "none")


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (["--trust", "verified"], "--trust verified needs --site-key, the site.public of skyless site keys"),
        (["--clock-bound-ms", "20"], "--clock-bound-ms needs --site-key"),
        (["--site-key", "KEYS", "--site-id", "9"], "--site-id is 9, but"),
        (["--site-key", "none"], "none is missing"),
        (["--site-key", "KEYS", "--radio", "sniffer:/dev/null"], "it is not for sniffers, FiRa boards and phones"),
    ],
)
def test_wrong_options_of_a_tag_are_refused(keys_folder, complaint, arguments, words):
    given = [str(keys_folder / "site.public") if one == "KEYS" else one for one in arguments]
    assert words in complaint("tag", "t1", "--mqtt", "none", *given)


@played
async def test_stamps_of_beacons_that_are_not_accepted_are_not_kept(keys_folder, clock):
    """A survey would use them."""
    async with Stage(keys_folder) as stage:
        await asyncio.sleep(1.0)
        for chains, is_kept in ((OTHER_KEYS.chains, False), ((), False), (KEYS.chains, True)):
            now_ticks = stage.radios[0].now_ticks()
            sender = Anchor(FREE, 2, authentication=BeaconAuthentication(chains))
            sender.authentication.set_time(now_ticks, START_UNIX_S + 1.0)
            tx_ticks = sender.next_transmission_ticks(now_ticks)
            stage.node.on_event(Reception(sender.transmission(tx_ticks).frame, now_ticks))
            assert (2 in stage.node.heard_s) is is_kept


def moved(site, x_m=0.0, ticks=0, rx_ticks=0):
    """The site with one anchor elsewhere, or with other delays."""
    first = site.anchors[0]
    delays = {"tx_antenna_delay_ticks": ticks, "rx_antenna_delay_ticks": rx_ticks}
    first = replace(first, x_m=first.x_m + x_m, **{name: getattr(first, name) + more for name, more in delays.items()})
    return replace(site, anchors=(first, *site.anchors[1:]))


def placement(before, after):
    return PlacementMessage(0.0, site_digest(before), after)


def keyed_node(folder, said, site=FREE, **options):
    put(folder, FIRST)
    return AnchorNode(
        site, 1, FakeRadio("1"), said.append, key_files.AnchorKeys(folder, site.id, said.append, {}), **options
    )


@pytest.mark.parametrize(
    ("change", "far"),
    [((3.0,), "3.00"), ((-0.51,), "0.51"), ((0.0, 200), "0.94"), ((0.0, 60, 60), "0.56"), ((0.3, -60, -60), "0.86"),
     ((0.3, 0, 60), "0.58")],
)  # fmt: skip
def test_a_placement_far_from_the_site_file_moves_no_anchor_with_keys(tmp_path, change, far):
    """Its codes would vouch for what anybody with the password of a survey sends."""
    said = []
    node, message = keyed_node(tmp_path, said), placement(FREE, moved(FREE, *change))
    assert not node.place(message)
    assert not node.place(message)
    assert node.site is FREE
    assert node.refused == {"placement-refused": 2}
    assert len(said) == 1
    assert re.search(f"ignored: they change a range by {far} m from.*0.5 m.*--allow-placement", said[0])
    assert keyed_node(tmp_path, said, allow_placement=True).place(message)
    assert AnchorNode(FREE, 1, FakeRadio("1"), said.append).place(message)
    assert keyed_node(tmp_path, said).place(placement(FREE, moved(FREE, 0.2, 60, -60)))


def test_many_small_placements_do_not_add_up(tmp_path):
    node = keyed_node(tmp_path, [])
    assert node.place(placement(FREE, moved(FREE, 0.4)))
    assert not node.place(placement(node.site, moved(node.site, 0.4)))
    assert node.place(placement(node.site, moved(node.site, -0.4)))
    assert node.refused == {"placement-refused": 1}


def test_an_anchor_with_keys_and_no_position_is_placed_only_where_that_is_allowed(tmp_path):
    first = FREE.anchors[0]
    site = replace(
        FREE,
        anchors=FREE.anchors[1:],
        unplaced=(UnplacedAnchor(first.id, first.slot, first.tx_antenna_delay_ticks, first.rx_antenna_delay_ticks),),
    )
    assert not keyed_node(tmp_path, [], site).place(placement(site, FREE))
    assert keyed_node(tmp_path, [], site, allow_placement=True).place(placement(site, FREE))
