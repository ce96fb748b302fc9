"""The vectors' board, chip and wire for tests in CPython, and what a board said as values."""

import importlib.util
import sys
from pathlib import Path

from cobs import cobs

from skyless.firmware import board
from skyless.radios.link_records import decode

VECTORS = Path(__file__).with_name("board_vectors.py")
FOLDER = Path(board.__file__).parent


def module_of_vectors():
    """The vectors as a module, over the board that tests import."""
    spec = importlib.util.spec_from_file_location("board_vectors_here", VECTORS)
    module = importlib.util.module_from_spec(spec)
    arguments, sys.argv = sys.argv, [str(VECTORS), str(FOLDER)]
    sys.modules["board"] = board
    try:
        spec.loader.exec_module(module)
    finally:
        sys.argv = arguments
        sys.path.remove(str(FOLDER))
        del sys.modules["board"]
    return module


vectors = module_of_vectors()


def records(said):
    """Raw records of what a board has sent, by the package ``cobs``."""
    return [cobs.decode(piece)[:-2] for piece in bytes(said).split(b"\0") if piece]


def values(said):
    return [decode(record) for record in records(said)]
