"""Unicorn's C interface (unicorn/unicorn.h), where its Python binding is too slow.

The binding's hooks are functions of Python, which cost a microsecond a block, and its wrappers of memory windows double
the time of an access. The functions of C are public; the handle of an engine is not, so another release of the binding
may need a change here.
"""

import ctypes
from collections.abc import Callable
from typing import Final

from unicorn import UC_HOOK_BLOCK, Uc, UcError
from unicorn.unicorn_py3.unicorn import uclib

Load = Callable[[int, int], int]
"""Offset in a window and bytes of a load; its value. Must not raise."""
Store = Callable[[int, int, int], None]
"""Offset in a window, bytes and value of a store. Must not raise."""

_LOAD = ctypes.CFUNCTYPE(ctypes.c_uint64, ctypes.c_void_p, ctypes.c_uint64, ctypes.c_uint, ctypes.c_void_p)
_STORE = ctypes.CFUNCTYPE(None, ctypes.c_void_p, ctypes.c_uint64, ctypes.c_uint, ctypes.c_uint64, ctypes.c_void_p)

stop_engine: Final = ctypes.CFUNCTYPE(ctypes.c_int, ctypes.c_void_p)(("uc_emu_stop", uclib))
"""Stops an engine, called with its handle by a hook in C."""


def _handle(engine: Uc) -> ctypes.c_void_p:
    handle: ctypes.c_void_p = engine._uch
    return handle


def hook_blocks(engine: Uc, function_address: int, data_address: int) -> None:
    """Call a function of C before each block of instructions: with engine, address, bytes, and ``data_address``."""
    _check(
        uclib.uc_hook_add(
            _handle(engine),
            ctypes.byref(ctypes.c_size_t()),
            UC_HOOK_BLOCK,
            ctypes.c_void_p(function_address),
            ctypes.c_void_p(data_address),
            ctypes.c_uint64(1),  # from here to there: everywhere
            ctypes.c_uint64(0),
        )
    )


def map_window(engine: Uc, base: int, size: int, load: Load, store: Store) -> object:
    """Let functions answer for a window of addresses; what is returned must live as long as the engine."""

    def on_load(_engine: int, offset: int, width: int, _data: int) -> int:
        return load(offset, width)

    def on_store(_engine: int, offset: int, width: int, value: int, _data: int) -> None:
        store(offset, width, value)

    functions = _LOAD(on_load), _STORE(on_store)
    _check(uclib.uc_mmio_map(_handle(engine), base, size, functions[0], None, functions[1], None))
    return functions


def _check(status: int) -> None:
    if status:
        raise UcError(status)
