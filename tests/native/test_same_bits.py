"""The Python of estimator, receiver and search, and the C that is made from it: the same bits.

Function by function, packet by packet, frame by frame, position by position, and compiler by compiler.
"""

import ctypes
import inspect
import os
import subprocess
from collections import Counter
from functools import cache

import estimator_builders as builders
import numpy as np
import pytest
from core_build import (
    ERRORS,
    EXACT,
    NATIVE,
    SITES,
    disturbed,
    in_webassembly,
    input_of,
    needs,
    runner,
    same_rows,
    track,
)
from estimator_builders import LAB_M, MESH, ROOM_M, begun, episode_of, late_from, one_by_one, settings_of
from msgspec.structs import replace

import wasm_core
from make_core import EXPORTS, FILES
from skyless.core.air.almanac import GeoreferencePage, NoisePage, SitePage
from skyless.core.air.beacon import Beacon, StatedPosition, decode, encode
from skyless.core.air.frame import Diagnostics, Heard, PackedHeard
from skyless.core.air.site_pages import site_issue
from skyless.core.estimator.process import ACCEPTED, Packet, process_frame
from skyless.core.estimator.state import WORK_ROWS, State
from skyless.core.estimator.steady_state import PlannedMessage, PlannedRelay
from skyless.core.native import arithmetic
from skyless.core.native.library import compiled
from skyless.core.native.records import MAX_ANCHORS, c_type
from skyless.core.native.views import view
from skyless.core.pages import site_page_for, site_pages_of
from skyless.core.tag import position, receiver, search
from skyless.core.tag.hearing import hear_frame
from support.bench import ROOM, tape
from support.frames import with_fcs
from translator.body import Translator
from translator.files import translate
from translator.types import INT, REAL, Elements, Number, Results, Struct, parameter_type

pytestmark = [pytest.mark.site, needs("gcc")]

TRANSLATOR = Translator(EXPORTS)
POINTED = ctypes.Structure | ctypes.Array


def bits(value):
    """The bytes of a value, without those between the fields of records and what is not in use of a state."""
    if isinstance(value, State):
        parts = (value.levels, value.U, value.G)
        return builders.bytes_in_use(value) + b"".join(view(part).tobytes() for part in parts)
    if isinstance(value, POINTED):
        return np.frombuffer(value, np.uint8)[contents(type(value))].tobytes()
    return value


@cache
def contents(made):
    """Which bytes of a type are not between the fields of records."""
    if issubclass(made, ctypes.Array):
        return np.tile(contents(made._type_), made._length_)
    found = np.full(ctypes.sizeof(made), not issubclass(made, ctypes.Structure))
    for name, kind in getattr(made, "_fields_", ()):
        begin = getattr(made, name).offset
        found[begin : begin + ctypes.sizeof(kind)] = contents(kind)
    return found


# The files


@pytest.mark.parametrize(("name", "exports", "by_hand"), FILES, ids=[name for name, *_ in FILES])
def test_the_files_are_what_their_source_makes(name, exports, by_hand):
    for text, suffix in zip(translate(exports, name, by_hand), ("h", "c"), strict=True):
        assert (NATIVE / f"{name}.{suffix}").read_text() == text, "run scripts/core"
    assert name != "skyless_core" or "math.h" not in text, "its bits would depend on the machine"


def test_records_are_as_large_as_in_c(tmp_path):
    made = TRANSLATOR.records.values()
    lines = "".join(f'printf("%zu\\n", sizeof({one.__name__}));' for one in made)
    program = f'#include <stdio.h>\n#include "skyless_core.h"\nint main(void) {{ {lines} return 0; }}'
    (tmp_path / "sizes.c").write_text(program)
    subprocess.run(["gcc", f"-I{NATIVE}", tmp_path / "sizes.c", "-o", tmp_path / "sizes"], check=True)
    found = subprocess.run([tmp_path / "sizes"], capture_output=True, check=True).stdout.split()
    assert [int(size) for size in found] == [ctypes.sizeof(one) for one in made]


# Function by function

SKIPPED = {"track", "find_steady_state", "find_walked", "process_superframe", "process_known"}
"""Their arguments are tables; the runs below, and the tests of planning and bounds, cover them …"""
SKIPPED |= {"begin_filter", "add_choice", "complete"}
"""… and these the frames below."""
OF_POSITIONS = {module.__name__ for module in (search, position, arithmetic)}
"""The positions below cover these."""
ONE_BY_ONE = {name for name, one in TRANSLATOR.functions.items() if one.__module__ not in OF_POSITIONS} - SKIPPED
REALS = {
    "integrity_risk": 1e-3, "risk": 1e-5, "dt": 0.02, "elapsed_s": 0.1, "age_s": 0.05, "ratio": 0.7, "sign": 1.0,
    "kept": 0.9,
}  # fmt: skip


@pytest.fixture(scope="module")
def everything(tmp_path_factory):
    """A library of all functions, also those that are called inside only."""
    made = tmp_path_factory.mktemp("all") / "all.so"
    own = ("-DINTERNAL=", "-shared", "-fPIC", "-Wl,-Bsymbolic")  # not libc's, which has some of these names as well
    subprocess.run(["gcc", *EXACT, "-O1", *own, NATIVE / "skyless_core.c", "-o", made], check=True)
    return ctypes.CDLL(str(made))


@pytest.fixture(scope="module")
def states():
    """States in the middle of things: two and three dimensions, exact and not, with and without a jump."""
    found = []
    for seed, (anchors_m, height_m, errors) in enumerate(SITES.values()):
        episode = episode_of(MESH, 16, seed + 1, anchors_m)
        estimator = begun(episode, settings_of(height_m=height_m, stationary_s=0.5, **errors), anchors_m, std_m=0.05)
        for packet in one_by_one(disturbed(episode, seed)):
            estimator.process(*packet)
        view(estimator.state.work)[:] = np.random.default_rng(seed).uniform(0.5, 1.5, (WORK_ROWS, MAX_ANCHORS))
        found.append(estimator.state)
    return found


def drawn_number(name, s, draw, anchor):
    """A number that a parameter of this name may have; where it is an anchor, not another's."""
    ahead = s.status.epoch_ticks + int(draw.integers(1, 10**9))
    where = {
        "rx_ticks": ahead, "tx_ticks": s.anchors[anchor].tx_ticks + int(draw.integers(1, 10**9)), "now": ahead,
        "packet_rx_ticks": ahead - 10**9, "impulses_ticks": s.status.epoch_ticks, "superframe": 10**9,
        "subticks": int(draw.integers(0, 2**48)), "kind": int(draw.integers(3)), "axes": s.dim, "dim": s.dim,
        "state": int(draw.integers(s.n)), "value": anchor + s.dim, "index": int(draw.integers(s.layout.end)),
        "count": min(s.count, 5), "faults": 3 * s.count, "vectors": 1, "begin": 0, "end": 20, "identifier": 77,
        "range_errors": int(draw.integers(3)), "length": 117 - int(draw.integers(4) == 0), "row": 3, "k": 0, "at": 20,
        "packed_bytes": 16, "axis": int(draw.integers(3)), "bits": 40, "size": 3, "other": (anchor + 2) % s.count,
        **dict.fromkeys(("master", "sender", "b"), (anchor + 1) % s.count),
    }  # fmt: skip
    return where.get(name, anchor)


def arguments(function, state, seed):
    """What a function is called with; the state is the first."""
    s, draw = State.from_buffer_copy(state), np.random.default_rng(seed)
    found, anchor = [], int(draw.integers(s.count))
    for name, kind in parameters(function).items():
        if kind == Struct(State):
            found.append(s)
        elif isinstance(kind, Struct):
            found.append(drawn_record(kind.made, s, draw))
        elif kind == REAL:
            found.append(REALS.get(name, abs(float(draw.normal())) + 1e-3))
        elif isinstance(kind, Number):
            found.append(bool(draw.integers(2)) if kind.name == "bool" else drawn_number(name, s, draw, anchor))
        elif kind.element == INT:
            found.append((ctypes.c_int32 * 3)(1000, -2000, 0))
        else:
            found.append((ctypes.c_double * 512)(*draw.normal(size=512)) if kind.element == REAL else frame_of(draw))
    return found


def parameters(function):
    """The translator's types of them."""
    hints = inspect.get_annotations(function, eval_str=True)
    return {name: parameter_type(hint) for name, hint in hints.items() if name != "return"}


def frame_of(draw):
    """A beacon as anchors send it, or with a few other bytes and the right check sequence."""
    heard = tuple(Heard(k + 1, int(draw.integers(256)), int(draw.integers(2**40))) for k in range(8))
    place = StatedPosition(*draw.uniform(-9.0, 9.0, 3), 0.02, -1, 3)
    page = [SitePage(3, 1.5), NoisePage(1e-10, 1e-10, 0.0, 1e-9), GeoreferencePage(48.0, -11.0, 500.0, 10.0)]
    one = Beacon(3, 0, 7, int(draw.integers(2**40)), 5, 0x21, place, heard, 5, page[int(draw.integers(3))])
    body = bytearray(encode(one)[:-2])
    for _ in range(int(draw.integers(3))):
        body[int(draw.integers(11, len(body)))] = int(draw.integers(256))
    return with_fcs(body)


def drawn_record(made, s, draw):
    one = made()
    if made is Packet:
        anchor = int(draw.integers(s.count))
        a = s.anchors[anchor]
        one.place.anchor, one.place.std_m = a.identifier, -1.0
        view(one.place.position_m)[:] = view(a.position_m)
        one.sequence, one.variance_factor, one.master = 7, 1.5, s.anchors[0].identifier
        one.rx_ticks = s.status.epoch_ticks + 10**8
        one.tx_ticks = a.tx_ticks + one.rx_ticks - a.rx_ticks
        one.subticks, one.report_variance_m2 = 12345, 1e-3
    elif made is PlannedMessage:
        one.anchor, one.share, one.late_m = int(draw.integers(s.count)), 0.7, 0.1
    elif made is PlannedRelay:
        one.sender, one.share, one.age_s, one.late_m = int(draw.integers(s.count)), 0.6, 0.01, 0.2
    else:
        fill(one, draw)
    return one


def fill(value, draw):
    """Small numbers in all fields and in the first elements, so that they fit any table, and stamps of seconds."""
    few, is_record = 6, isinstance(value, ctypes.Structure)
    for name, kind in value._fields_ if is_record else [(at, value._type_) for at in range(min(few, len(value)))]:
        if name == "parent":
            view(value.parent)[:] = np.arange(-1, len(value.parent) - 1)
        elif issubclass(kind, POINTED):
            fill(getattr(value, name) if is_record else value[name], draw)
        else:
            number = draw.integers(2 * 10**11) if kind is ctypes.c_int64 else draw.integers(1, few)
            number = draw.normal(0.0, 10.0) if kind is ctypes.c_double else kind(int(number)).value
            number = {"dim": int(draw.integers(2, 4)), "bits": 40}.get(name, number)
            setattr(value, name, number) if is_record else value.__setitem__(name, number)


@pytest.mark.parametrize("name", sorted(ONE_BY_ONE))
def test_a_function_gives_the_same_bits(everything, states, name):
    function = TRANSLATOR.functions[name]
    called = everything[f"skyless_{name}" if function in EXPORTS else name]
    hints = inspect.get_annotations(function, eval_str=True)
    returned = hints["return"]
    kind = None if returned is None else parameter_type(returned)
    if isinstance(kind, Results):
        items = [(f"item_{k}", ctypes.c_double) for k in range(len(kind.items))]
        called.restype = type("Results", (ctypes.Structure,), {"_fields_": items})
    else:
        called.restype = ctypes.c_void_p if isinstance(kind, Struct) else kind and c_type(returned)
    called.argtypes = [
        ctypes.c_void_p if isinstance(one, Elements | Struct) else c_type(hints[name])
        for name, one in parameters(function).items()
    ]
    for seed, state in enumerate(states * 4):
        ours, theirs = arguments(function, state, seed), arguments(function, state, seed)
        expected = function(*ours)
        found = called(*(ctypes.byref(one) if isinstance(one, POINTED) else one for one in theirs))
        assert [bits(one) for one in ours] == [bits(one) for one in theirs]
        if isinstance(kind, Results):
            found = tuple(getattr(found, name) for name, _ in items)
        if not isinstance(kind, Struct):
            assert np.array_equal(np.array(expected, float), np.array(found, float), equal_nan=True)


def test_there_is_room_for_all_anchors_and_no_more(states):
    s, packet = State.from_buffer_copy(states[2]), Packet()
    packet.place.std_m = -1.0
    for anchor in range(100, 100 + MAX_ANCHORS):
        room, packet.place.anchor = s.count < MAX_ANCHORS, anchor
        assert (TRANSLATOR.functions["present"](s, packet.place) >= 0) == room
    assert s.count == MAX_ANCHORS


# Packet by packet


@pytest.mark.parametrize("name", ["as they are", "late", "3-D", "lost"])
def test_python_and_c_do_the_same_with_every_packet(name):
    """To and fro between the anchors at some 1 m/s, and at rest for the last third."""

    def with_range_errors(packets):
        """Each anchor's range is wrong by a constant of its own."""
        return builders.late(packets, draw.uniform(-0.05, 0.05, packets.anchors.max() + 1)[packets.anchors])

    def with_late_ones(packets):
        """Single packets are late; one anchor is for the second third, another for the last quarter."""
        count = len(packets.anchors)
        some = np.where(draw.random(count) < 0.05, draw.exponential(1.0, count), 0.0)
        packets = late_from(builders.late(with_range_errors(packets), some), 2, 0.5, count // 3, 2 * count // 3)
        return late_from(packets, 4, 1.5, 3 * count // 4)

    def with_losses(packets):
        """Half of all is lost; one anchor is silent for the second third, another's clock jumps in the middle."""
        count = len(packets.anchors)
        packets = builders.jumped(packets, 1, count // 2, 30.0)
        is_silent = (packets.anchors == 3) & (np.arange(count) // (count // 3) == 1)
        return builders.kept(packets, (draw.random(count) > 0.5) & ~is_silent)

    anchors_m, height_m, errors, changed = {
        "as they are": (LAB_M, 0.0, {}, lambda packets: packets),
        "late": (LAB_M, 0.0, ERRORS, with_late_ones),
        "3-D": (ROOM_M, None, ERRORS, with_range_errors),
        "lost": (ROOM_M, 0.0, ERRORS, with_losses),
    }[name]
    frames, draw = int(os.environ.get("SKYLESS_FUZZ_FRAMES", "240")), np.random.default_rng(1)
    time_s = np.minimum(np.arange(frames), 2 * frames // 3)[:, None] * builders.SLOT_S
    low_m, high_m = anchors_m.min(axis=0), anchors_m.max(axis=0)
    swing_m = 0.4 * (high_m - low_m) * np.sin(draw.uniform(0.2, 0.4, 3) * time_s + draw.uniform(0.0, 6.0, 3))
    path_m = (low_m + high_m) / 2.0 + swing_m
    if height_m is not None:
        path_m[:, 2] = height_m
    episode = episode_of(MESH, frames // len(anchors_m), 1, anchors_m, path_m=path_m)
    settings = settings_of(height_m=height_m, stationary_s=0.5, **errors)
    in_c, plain = begun(episode, settings, anchors_m), begun(episode, settings, anchors_m)
    outcomes = Counter()
    for number, packet in enumerate(one_by_one(changed(episode.packets))):
        outcome = process_frame(plain.state, *plain.packet_of(*packet), b"", 0)
        assert (in_c.process(*packet), in_c.rows) == (outcome, plain.rows), f"packet {number}"
        assert bits(in_c.state) == bits(plain.state), f"packet {number}"
        outcomes[outcome] += 1
    assert outcomes[ACCEPTED] > frames / 3


# Frame by frame

FREE = replace(ROOM, schedule=replace(ROOM.schedule, mode="free", rate_hz=60.0))
PHASES = replace(FREE, schedule=replace(FREE.schedule, carrier_phase=True))
OTHERS = site_pages_of(replace(FREE, tags=replace(FREE.tags, height_m=0.1)))
"""Pages by which the height is known."""
COUNTED = {
    "moved-anchor", "duplicate", "bad-fcs", "impossible-stamp", "foreign-site", "impossible-host-time", "counter-jump",
}  # fmt: skip


@pytest.mark.parametrize("site", [FREE, PHASES], ids=["stamps", "phases"])
def test_a_receiver_gives_the_same_bits(monkeypatch, site):
    """Frames repeated, damaged, under other names or sites, with other stamps; a survey; a counter that restarts."""

    def surveyed(received):
        """A beacon half a metre from where it was, with other pages."""
        beacon = decode(received.frame)
        place = replace(beacon.position, x_m=beacon.position.x_m + 0.5)
        page, heard = site_page_for(OTHERS, beacon.sequence, beacon.anchor), beacon.heard.packed[:32]
        changed = replace(beacon, position=place, almanac_issue=site_issue(OTHERS), page=page, weak=0)
        return replace(received, frame=encode(replace(changed, heard=PackedHeard(heard, beacon.has_phases))))

    heard, sent, draw = [one.reception for one in tape(site, 1.2)], [], np.random.default_rng(4)
    after = len(heard) // 3
    for number, received in enumerate([*heard[:after], *map(surveyed, heard[after:])]):
        beacon, change = decode(received.frame), draw.random()
        one = replace(received, diagnostics=Diagnostics(-80.0, -80.0 - 14.0 * draw.random()))
        if number > 0.8 * len(heard):  # five seconds back
            one = replace(one, rx_ticks=(one.rx_ticks - 3 * 10**11) % 2**40, host_s=None)
        sent.append(one)
        soon = replace(one, rx_ticks=one.rx_ticks + 10**6)
        if change < 0.05:
            sent.append(one)
        elif change < 0.1:
            sent.append(replace(one, frame=one.frame[:-1] + b"\0", rx_ticks=one.rx_ticks + 10))
        elif change < 0.2:
            forged = {"tx_ticks": int(draw.integers(2**40)), "anchor": int(draw.integers(1, 12)), "heard": ()}
            sent.append(replace(soon, frame=encode(replace(beacon, **forged, weak=0))))
        elif change < 0.25:
            sent.append(replace(soon, frame=encode(replace(beacon, site=77))))
        elif change < 0.3:
            sent.append(replace(soon, host_s=1e300))
    in_c, plain, fixes = receiver.Receiver(), receiver.Receiver(), 0
    for one in sent:
        expected = in_c.hear(one)
        with monkeypatch.context() as patched:
            patched.setattr(receiver, "_hear_frame", hear_frame)
            found = plain.hear(one)
        said = [fix and (fix.rows, fix.time_s, fix.anchors) for fix in (found, expected)]
        assert said[0] == said[1]
        assert bits(plain.tag) == bits(in_c.tag)
        assert (plain.reason, plain.counters) == (in_c.reason, in_c.counters)
        fixes += found is not None
    assert fixes > 100
    assert plain.almanac.pages.site.tag_height_m == 0.1
    assert plain.counters.keys() >= COUNTED


# Position by position


def test_a_position_has_the_same_bits():
    """Anchors in a room, in a plane, nearly in a line, or on a lattice; TDoAs with little, much or absurd noise."""
    draw, in_c, kinds, reasons = np.random.default_rng(6), compiled(position.find_position), Counter(), Counter()
    for _ in range(400):
        anchors = int(draw.integers(3, 10)) if draw.random() < 0.95 else MAX_ANCHORS
        anchors_m = draw.uniform(0.0, [20.0, 10.0, 5.0], (anchors, 3))
        shape = int(draw.integers(5))
        if shape == 1:
            anchors_m[:, 2] = 2.5
        elif shape == 2:
            anchors_m[:, 2] = anchors_m[:, 0] + 10.0 ** draw.uniform(-9.0, 0.0) * draw.normal(size=anchors)
        elif shape == 3:
            anchors_m[:, 1:] = anchors_m[:, :1] + 10.0 ** draw.uniform(-7.0, 0.0) * draw.normal(size=(anchors, 2))
        elif shape == 4:
            anchors_m = np.round(anchors_m / 4.0) * 4.0
        tag_m, std_m = draw.uniform(-3.0, [23.0, 13.0, 8.0]), 10.0 ** draw.uniform(-4.0, 0.0)
        ranges_m = np.linalg.norm(anchors_m - tag_m, axis=1)
        ranges_m += std_m * draw.choice([0.0, 1.0, 10.0, 300.0]) * draw.normal(size=anchors)
        flags = {name: bool(draw.integers(2)) for name in ("knows_height", "is_weighted", "has_bounds")}
        numbers = {"height_m": tag_m[2], "low_m": 0.0, "high_m": 5.0, "residual_tail": draw.choice([0.0, 1e-9])}
        ours = search.LocateProblem(anchors=anchors, **flags, **numbers)
        view(ours.anchors_m)[:anchors], view(ours.tdoa_m)[: anchors - 1] = anchors_m, ranges_m[1:] - ranges_m[0]
        root = draw.normal(size=(anchors - 1, anchors - 1))
        covariance = std_m**2 * (1.0 + np.eye(anchors - 1) + 0.1 * root @ root.T)
        view(ours.covariance)[: anchors * (anchors - 1) // 2] = covariance[np.tril_indices(anchors - 1)]
        theirs, found, found_in_c = type(ours).from_buffer_copy(ours), position.Found(), position.Found()
        reason = position.find_position(ours, found)
        assert in_c(theirs, found_in_c) == reason
        numbers = [np.frombuffer(one, float).copy() for one in (found, ours, found_in_c, theirs)]
        for one in numbers:
            one[np.isnan(one)] = np.nan  # what is no number has the same bits everywhere then
        assert [one.tobytes() for one in numbers[:2]] == [one.tobytes() for one in numbers[2:]]
        kinds[ours.kind] += 1
        reasons[reason] += 1
    assert min(kinds[kind] for kind in (search.FREE, search.HEIGHT, search.PLANE)) > 50
    expected = ("FOUND", "IMPOSSIBLE", "MIRROR", "RESIDUALS", "SINGULAR", "UNCERTAIN")
    assert min(reasons[getattr(position, name)] for name in expected) > 2


# Compiler by compiler


@pytest.mark.parametrize(
    ("compiler", "flags", "emulator"),
    [
        pytest.param("gcc", ["-O1"], [], marks=needs("gcc")),
        pytest.param("gcc", ["-O3", "-march=native"], [], marks=needs("gcc")),
        pytest.param("clang", ["-O3"], [], marks=needs("clang")),
        pytest.param("aarch64-linux-gnu-gcc", ["-O2", "-static"], ["qemu-aarch64"],
                     marks=needs("aarch64-linux-gnu-gcc", "qemu-aarch64")),
        pytest.param("WebAssembly", [], [], marks=needs("clang", "wasm-ld", "node")),
    ],
)  # fmt: skip
def test_all_compilers_and_processors_give_the_same_bits(compiler, flags, emulator, tmp_path):
    episode = episode_of(MESH, 60, 5, ROOM_M)
    packets = disturbed(episode, 9)
    estimator = begun(episode, settings_of(height_m=None, **ERRORS), ROOM_M, std_m=0.1)
    given = input_of(estimator, packets, ROOM_M)
    rows = estimator.track(packets, has_levels=True)
    if compiler == "WebAssembly":
        wasm_core.build(tmp_path / "core.wasm")
        command = in_webassembly(tmp_path / "core.wasm")
    else:
        command = [*emulator, runner(tmp_path, compiler, *flags)]
    found, state = track(command, given)
    assert bits(state) == bits(estimator.state)
    assert same_rows(rows, found)
