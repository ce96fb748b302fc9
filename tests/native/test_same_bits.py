"""The estimator's Python and the C that is made from it: the same bits, function by function, compiler by compiler."""

import ctypes
import inspect
import subprocess
import sys
from functools import cache
from pathlib import Path

import numpy as np
import pytest
from core_build import NATIVE, disturbed, has, input_of, library_of_all, rows_and_state, runner

sys.path.insert(0, str(Path(__file__).parents[1] / "core"))
sys.path.insert(0, str(Path(__file__).parents[2] / "tools"))

from estimator_builders import LAB_M, MESH, ROOM_M, begun, bytes_in_use, episode_of, one_by_one, settings_of

import wasm_core
from make_core import EXPORTS, FILES
from skyless.core.air.almanac import GeoreferencePage, NoisePage, SitePage
from skyless.core.air.beacon import Beacon, StatedPosition, encode
from skyless.core.air.frame import Heard, fcs
from skyless.core.estimator.process import BatchPacket, BatchRow, Packet, Place, Relay
from skyless.core.estimator.state import WORK_ROWS, State
from skyless.core.estimator.steady_state import PlannedMessage, PlannedRelay
from skyless.core.native import arithmetic
from skyless.core.native.records import MAX_ANCHORS, c_type
from skyless.core.native.views import view
from skyless.core.tag import position, search
from translator.body import Translator
from translator.files import translate
from translator.types import INT, REAL, Elements, Number, Results, Struct, parameter_type

pytestmark = [pytest.mark.site, pytest.mark.skipif(not has("gcc"), reason="there is no gcc")]

ERRORS = {"survey_std_m": 0.02, "range_std_m": 0.03, "slope_std_m": 0.05, "place_std_m": 0.005}
SITES = [(LAB_M, 0.0, {}), (ROOM_M, 0.0, ERRORS), (ROOM_M, None, ERRORS)]
FUNCTIONS = Translator(EXPORTS).functions


@pytest.mark.parametrize(("name", "exports", "by_hand"), FILES, ids=[name for name, *_ in FILES])
def test_the_files_are_what_their_source_makes(name, exports, by_hand):
    header, source = translate(exports, name, by_hand)
    assert (NATIVE / f"{name}.h").read_text() == header, "run scripts/core"
    assert (NATIVE / f"{name}.c").read_text() == source, "run scripts/core"


def test_the_core_calls_no_function_whose_bits_depend_on_the_machine():
    assert "math.h" not in (NATIVE / "skyless_core.c").read_text()


@pytest.fixture(scope="module")
def everything(tmp_path_factory):
    return library_of_all(tmp_path_factory.mktemp("all"), "gcc", "-O3")


@pytest.fixture(scope="module")
def states():
    """States in the middle of things: two and three dimensions, exact and not, with and without a jump."""
    found = []
    for seed, (anchors_m, height_m, errors) in enumerate(
        [(LAB_M, 0.0, {}), (ROOM_M, 0.0, ERRORS), (ROOM_M, None, ERRORS)]
    ):
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
        "rx_ticks": ahead,
        "tx_ticks": s.anchors[anchor].tx_ticks + int(draw.integers(1, 10**9)),
        "packet_rx_ticks": ahead - 10**9,
        "impulses_ticks": s.status.epoch_ticks,
        "now": ahead,
        "superframe": 10**9,
        "subticks": int(draw.integers(0, 2**48)),
        "kind": int(draw.integers(3)),
        "axes": s.dim,
        "state": int(draw.integers(s.n)),
        "value": anchor + s.dim,
        "index": int(draw.integers(s.layout.end)),
        "count": min(s.count, 5),
        "vectors": 1,
        "faults": 3 * s.count,
        "end": 20,
        "begin": 0,
        "dim": s.dim,
        "range_errors": int(draw.integers(3)),
        "identifier": 77,
        "master": (anchor + 1) % s.count,
        "other": (anchor + 2) % s.count,
        "sender": (anchor + 1) % s.count,
        "b": (anchor + 1) % s.count,
        "row": 3,
        "k": 0,
        "packed_bytes": 16,
        "length": 117 - int(draw.integers(4) == 0),
        "at": 20,
        "axis": int(draw.integers(3)),
        "bits": 40,
        "size": 3,
    }
    return where.get(name, anchor)


REALS = {
    "integrity_risk": 1e-3,
    "risk": 1e-5,
    "dt": 0.02,
    "elapsed_s": 0.1,
    "age_s": 0.05,
    "ratio": 0.7,
    "sign": 1.0,
    "kept": 0.9,
}


def arguments(function, s, draw):
    """What a function is called with; the state is the first."""
    found, anchor = [], int(draw.integers(s.count))
    for name, hint in hints(function).items():
        kind = parameter_type(hint)
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


def frame_of(draw):
    """A beacon as anchors send it, or with a few other bytes and the right check sequence."""
    heard = tuple(Heard(k + 1, int(draw.integers(256)), int(draw.integers(2**40))) for k in range(8))
    place = StatedPosition(*draw.uniform(-9.0, 9.0, 3), 0.02, -1, 3)
    page = [SitePage(3, 1.5), NoisePage(1e-10, 1e-10, 0.0, 1e-9), GeoreferencePage(48.0, -11.0, 500.0, 10.0)]
    one = Beacon(3, 0, 7, int(draw.integers(2**40)), 5, 0x21, place, heard, 5, page[int(draw.integers(3))])
    body = bytearray(encode(one)[:-2])
    for _ in range(int(draw.integers(3))):
        body[int(draw.integers(11, len(body)))] = int(draw.integers(256))
    return bytes(body) + fcs(bytes(body))


def drawn_record(made, s, draw):
    one = made()
    if made is Packet:
        anchor = int(draw.integers(s.count))
        a = s.anchors[anchor]
        one.place.anchor, one.place.std_m = a.identifier, -1.0
        view(one.place.position_m)[:] = view(a.position_m)
        one.sequence, one.variance_factor, one.master = 7, 1.5, s.anchors[0].identifier
        one.rx_ticks, one.tx_ticks = (
            s.status.epoch_ticks + 10**8,
            a.tx_ticks + s.status.epoch_ticks + 10**8 - a.rx_ticks,
        )
        one.subticks, one.report_variance_m2 = 12345, 1e-3
    elif made is PlannedMessage:
        one.anchor, one.share, one.late_m = int(draw.integers(s.count)), 0.7, 0.1
    elif made is PlannedRelay:
        one.sender, one.share, one.age_s, one.late_m = int(draw.integers(s.count)), 0.6, 0.01, 0.2
    else:
        fill(one, draw)
    return one


FEW = 6


def fill(one, draw):
    """Small numbers in all fields, so that they fit any table, and stamps of seconds."""
    for name, kind in one._fields_:
        if name == "parent":
            view(one.parent)[:] = np.arange(-1, len(one.parent) - 1)
        elif issubclass(kind, ctypes.Structure | ctypes.Array):
            fill_elements(getattr(one, name), draw)
        elif name == "dim":
            one.dim = int(draw.integers(2, 4))
        elif name == "bits":
            one.bits = 40
        else:
            setattr(one, name, drawn_scalar(kind, draw))


def fill_elements(array, draw):
    if isinstance(array, ctypes.Structure):
        fill(array, draw)
        return
    for place in range(min(FEW, len(array))):
        if issubclass(array._type_, ctypes.Structure | ctypes.Array):
            fill_elements(array[place], draw)
        else:
            array[place] = drawn_scalar(array._type_, draw)


def drawn_scalar(kind, draw):
    if kind is ctypes.c_int64:
        return int(draw.integers(2 * 10**11))
    return float(draw.normal(0.0, 10.0)) if kind is ctypes.c_double else kind(int(draw.integers(1, FEW))).value


def hints(function):
    found = inspect.get_annotations(function, eval_str=True)
    return {name: hint for name, hint in found.items() if name != "return"}


def bits(value):
    if isinstance(value, State):
        return bytes_in_use(value) + view(value.levels).tobytes() + view(value.U).tobytes() + view(value.G).tobytes()
    if isinstance(value, ctypes.Structure | ctypes.Array):
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


SKIPPED = {"track", "find_steady_state", "find_walked", "process_superframe", "process_known"}
"""Their arguments are tables; the runs below, and the tests of planning and bounds, cover them …"""
SKIPPED |= {"begin_filter", "add_choice", "complete"}
"""… and these ``test_receiver_same_bits``."""
OF_POSITIONS = {module.__name__ for module in (search, search, position, search, arithmetic, search, arithmetic)}
"""``test_position_same_bits`` covers these."""
ONE_BY_ONE = {name for name, function in FUNCTIONS.items() if function.__module__ not in OF_POSITIONS}
POINTED = ctypes.Structure | ctypes.Array


@pytest.mark.parametrize("name", sorted(ONE_BY_ONE - SKIPPED))
def test_a_function_gives_the_same_bits(everything, states, name):
    function = FUNCTIONS[name]
    called = everything[f"skyless_{name}" if function in EXPORTS else name]
    returned = inspect.get_annotations(function, eval_str=True)["return"]
    kind = None if returned is None else parameter_type(returned)
    if isinstance(kind, Results):
        items = [(f"item_{k}", ctypes.c_double) for k in range(len(kind.items))]
        called.restype = type("Results", (ctypes.Structure,), {"_fields_": items})
    elif isinstance(kind, Struct):
        called.restype = ctypes.c_void_p
    else:
        called.restype = None if kind is None else c_type(returned)
    called.argtypes = [
        ctypes.c_void_p if isinstance(parameter_type(hint), Elements | Struct) else c_type(hint)
        for hint in hints(function).values()
    ]
    for seed, state in enumerate(states * 4):
        ours = arguments(function, State.from_buffer_copy(state), np.random.default_rng(seed))
        theirs = arguments(function, State.from_buffer_copy(state), np.random.default_rng(seed))
        expected = function(*ours)
        found = called(
            *(ctypes.byref(one) if isinstance(one, ctypes.Structure | ctypes.Array) else one for one in theirs)
        )
        assert [bits(one) for one in ours] == [bits(one) for one in theirs]
        if isinstance(kind, Results):
            found = tuple(getattr(found, name) for name, _ in items)
        if not isinstance(kind, Struct):
            assert np.array_equal(np.array(expected, float), np.array(found, float), equal_nan=True)


# Other compilers and processors


@pytest.fixture(scope="module")
def episode():
    packets = disturbed(episode_of(MESH, 60, 5, ROOM_M), 9)
    estimator = begun(episode_of(MESH, 60, 5, ROOM_M), settings_of(height_m=None, **ERRORS), ROOM_M, std_m=0.1)
    given = input_of(estimator, packets, ROOM_M)
    rows = estimator.track(packets, has_levels=True)
    return given, rows, estimator.state


TARGETS = {
    "gcc -O2": ("gcc", "-O2"),
    "gcc -O3 native": ("gcc", "-O3", "-march=native"),
    "clang -O3": ("clang", "-O3"),
    "aarch64": ("aarch64-linux-gnu-gcc", "-O3", "-static"),
}


@pytest.mark.parametrize("target", TARGETS)
def test_all_compilers_and_processors_give_the_same_bits(target, episode, tmp_path):
    compiler, *flags = TARGETS[target]
    emulator = ("qemu-aarch64",) if compiler.startswith("aarch64") else ()
    if not has(compiler, *emulator):
        pytest.skip(f"{' or '.join((compiler, *emulator))} is not here")
    given, rows, state = episode
    done = subprocess.run(
        runner(tmp_path, compiler, *flags, emulator=emulator), input=given, capture_output=True, check=True
    )
    found, theirs = rows_and_state(done.stdout, len(rows))
    assert bits(state) == bits(theirs)
    for name in rows.dtype.names:
        assert np.array_equal(rows[name], found[name])


@pytest.mark.skipif(not has("clang", "wasm-ld", "node"), reason="clang, lld or node is not here")
def test_webassembly_gives_the_same_bits(episode, tmp_path):
    wasm_core.build(tmp_path / "core.wasm")
    given, rows, state = episode
    sizes = [str(ctypes.sizeof(one)) for one in (State, Place, BatchPacket, Relay, BatchRow)]
    command = ["node", Path(__file__).with_name("run_core.mjs"), tmp_path / "core.wasm", *sizes]
    done = subprocess.run(command, input=given, capture_output=True, check=True)
    found, theirs = rows_and_state(done.stdout, len(rows))
    assert bits(state) == bits(theirs)
    for name in rows.dtype.names:
        assert np.array_equal(rows[name], found[name])


def test_records_are_as_large_as_in_c(tmp_path):
    made = Translator(EXPORTS).records.values()
    lines = "".join(f'printf("%zu\\n", sizeof({one.__name__}));' for one in made)
    (tmp_path / "sizes.c").write_text(
        f'#include <stdio.h>\n#include "skyless_core.h"\nint main(void) {{ {lines} return 0; }}'
    )
    subprocess.run(["gcc", f"-I{NATIVE}", tmp_path / "sizes.c", "-o", tmp_path / "sizes"], check=True)
    found = subprocess.run([tmp_path / "sizes"], capture_output=True, check=True).stdout.split()
    assert [int(size) for size in found] == [ctypes.sizeof(one) for one in made]


def test_there_is_room_for_all_anchors_and_no_more(states):
    s, packet = State.from_buffer_copy(states[2]), Packet()
    packet.place.std_m = -1.0
    for anchor in range(100, 100 + MAX_ANCHORS):
        room, packet.place.anchor = s.count < MAX_ANCHORS, anchor
        assert (FUNCTIONS["present"](s, packet.place) >= 0) == room
    assert s.count == MAX_ANCHORS
