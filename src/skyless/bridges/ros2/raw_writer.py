"""A writer of Cyclone DDS that takes messages as bytes, and announces its type by name only, as ROS 2's own does.

Cyclone's Python package announces a description of each type (XTypes). Fast DDS, which most of ROS 2 uses, then asks
for it before it matches a subscriber, and reports errors where several subscribers ask at once. So topic and writer are
made by the C interface of Cyclone DDS 11 (``dds.h``), which the package brings.
"""

import ctypes
from ctypes import POINTER, byref, c_char_p, c_int, c_int32, c_int64, c_size_t, c_uint32, c_void_p
from importlib import import_module
from typing import Any, Final

_DESCRIBED: Final = 0x40
"""``DDS_TOPIC_XTYPES_METADATA``: the descriptor's flag that the type's description is to be announced."""

_LOCAL: Final = 0
"""``DDS_FIND_SCOPE_LOCAL_DOMAIN``."""

_SAMPLE: Final = 2
"""``SDK_DATA``: the bytes are a whole message."""


class _Piece(ctypes.Structure):
    """``struct iovec``."""

    _fields_ = (("data", c_char_p), ("size", c_size_t))


class _Descriptor(ctypes.Structure):
    """The beginning of ``dds_topic_descriptor_t``."""

    _fields_ = (("size", c_uint32), ("align", c_uint32), ("flags", c_uint32))


_CALLS: Final = {
    "dds_get_typeinfo": (c_int32, (c_int32, POINTER(c_void_p))),
    "dds_free_typeinfo": (c_int32, (c_void_p,)),
    "dds_create_topic_descriptor": (c_int32, (c_int, c_int32, c_void_p, c_int64, POINTER(POINTER(_Descriptor)))),
    "dds_delete_topic_descriptor": (None, (POINTER(_Descriptor),)),
    "dds_create_topic": (c_int32, (c_int32, POINTER(_Descriptor), c_char_p, c_void_p, c_void_p)),
    "dds_create_writer": (c_int32, (c_int32, c_int32, c_void_p, c_void_p)),
    "dds_get_entity_sertype": (c_int32, (c_int32, POINTER(c_void_p))),
    "ddsi_serdata_from_ser_iov": (c_void_p, (c_void_p, c_int, c_size_t, POINTER(_Piece), c_size_t)),
    "dds_writecdr": (c_int32, (c_int32, c_void_p)),
}
"""What the functions return and take."""


class RawWriter:
    """Writes one topic. It lives as long as its participant."""

    def __init__(self, participant: Any, topic: str, kind: Any, quality: Any) -> None:  # noqa: ANN401 - see above
        """``kind`` is a class of ``idl.py``, ``quality`` a ``Qos``. Raises DDSException."""
        self._library: Final = _library()
        self._error: Final[Any] = import_module("cyclonedds.core").DDSException
        qualities = import_module("cyclonedds.qos")._CQos
        raw_quality = qualities.qos_to_cqos(quality)
        try:
            raw_topic = self._topic(participant, topic, kind, raw_quality)
            writer = self._library.dds_create_writer(participant._ref, raw_topic, raw_quality, None)
            self._writer: Final = self._checked(writer, f"a writer of {topic}")
        finally:
            qualities.cqos_destroy(raw_quality)
        self._type = c_void_p()
        found = self._library.dds_get_entity_sertype(self._writer, byref(self._type))
        self._checked(found, f"the type of {topic}")

    def write(self, data: bytes) -> None:
        """Write one message, CDR with its header. Raises DDSException, also where it is no message of the type."""
        padded = data + bytes(-len(data) % 4)
        piece = _Piece(padded, len(padded))
        message = self._library.ddsi_serdata_from_ser_iov(self._type, _SAMPLE, 1, byref(piece), len(padded))
        if message is None:
            raise self._error(self._error.DDS_RETCODE_BAD_PARAMETER, "the bytes are no message of this type")
        self._checked(self._library.dds_writecdr(self._writer, message), "a message")

    def _topic(self, participant: Any, name: str, kind: Any, raw_quality: Any) -> int:  # noqa: ANN401 - see above
        """A topic of the type whose description is not announced."""
        # One of the package, which nothing is ever written to, knows how the type is laid out.
        model = import_module("cyclonedds.topic").Topic(participant, f"{name}/model", kind)
        described, descriptor = c_void_p(), POINTER(_Descriptor)()
        library = self._library
        self._checked(library.dds_get_typeinfo(model._ref, byref(described)), f"the type of {name}")
        try:
            made = library.dds_create_topic_descriptor(_LOCAL, participant._ref, described, 0, byref(descriptor))
            self._checked(made, f"the layout of {name}")
        finally:
            library.dds_free_typeinfo(described)
        try:
            descriptor.contents.flags &= ~_DESCRIBED
            topic = library.dds_create_topic(participant._ref, descriptor, name.encode(), raw_quality, None)
            return self._checked(topic, f"the topic {name}")
        finally:
            library.dds_delete_topic_descriptor(descriptor)

    def _checked(self, result: int, what: str) -> int:
        """What a call returned, unless it is an error's number."""
        if result < 0:
            raise self._error(result, f"This was {what}.")
        return result


def _library() -> Any:  # noqa: ANN401 - C
    """The C library that the package has loaded, with the types of the functions that are called here."""
    library = ctypes.CDLL(import_module("cyclonedds.internal").DDS._dll_handle._name)
    for name, (result, arguments) in _CALLS.items():
        function = getattr(library, name)
        function.restype, function.argtypes = result, arguments
    return library
