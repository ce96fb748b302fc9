"""What a board that computes holds and sends, as its C lays it out (``firmware/source/fix.h``)."""

import ctypes

F32, U32, I32 = ctypes.c_float, ctypes.c_uint32, ctypes.c_int32


class AnchorInC(ctypes.Structure):
    _fields_ = (("id", U32), ("position_mm", I32 * 3))


class OriginInC(ctypes.Structure):
    _fields_ = (("latitude_e7", I32), ("longitude_e7", I32), ("height_mm", I32), ("heading_e7", U32))


class FixInC(ctypes.Structure):
    _fields_ = (
        *(("time_ticks", ctypes.c_int64), ("unix_us", ctypes.c_int64), ("rx_ticks", ctypes.c_uint64)),
        *((name, U32) for name in ("latency_us", "serial", "reason", "site", "tag", "is_height_known", "is_verified")),
        *(("position_mm", I32 * 3), ("velocity_mmps", I32 * 3)),
        *(("covariance_m2", F32 * 6), ("velocity_covariance", F32 * 6)),
        *((name, F32) for name in ("chi2", "mean_square_m2", "hpl_m", "vpl_m")),
        *(("levels", U32), ("risk", F32), ("alert_limit_m", F32), ("anchor_count", U32)),
        *(("anchors", AnchorInC * 8), ("has_origin", ctypes.c_bool), ("origin", OriginInC)),
    )

    def sent(self):
        """The body of FIX."""
        ids = [anchor.id.to_bytes(2, "little") for anchor in self.anchors[: self.anchor_count]]
        return bytes(self)[: FixInC.anchors.offset] + b"".join(ids)


class StatusInC(ctypes.Structure):
    _fields_ = tuple(
        (name, U32)
        for name in (
            *("site", "reason", "is_verified", "heard", "fixes", "overload_frames", "overload_superframes"),
            *("dropped", "receiver_on_ms", "asleep_ms"),
        )
    )


ANCHORS = (
    (1, (0, 0, 2500)),
    (2, (12_000, 0, 2500)),
    (3, (12_000, 8000, 2500)),
    (4, (0, 8000, 1000)),
    (7, (6000, 1, 500)),
)


def fix_in_c(**changed):
    """A fix in the middle of five anchors, with some fields changed."""
    fields = {
        "time_ticks": 63_897_600_000,
        "rx_ticks": 5,
        "latency_us": 1970,
        "serial": 9,
        "site": 3,
        "tag": 4,
        "position_mm": (4000, 3000, 1200),
        "velocity_mmps": (500, -250, 0),
        "covariance_m2": (4e-4, 1e-4, 0.0, 3e-4, 0.0, 9e-4),
        "velocity_covariance": (1e-3, 0.0, 0.0, 1e-3, 0.0, 1e-3),
        "chi2": 1.1,
        "mean_square_m2": 4e-4,
        "hpl_m": 0.12,
        "vpl_m": 0.2,
        "risk": 1e-4,
    } | changed
    fix = FixInC(anchor_count=len(ANCHORS))
    for name, value in fields.items():
        setattr(fix, name, type(getattr(fix, name))(*value) if isinstance(value, tuple) else value)
    for at, (number, place_mm) in enumerate(ANCHORS):
        fix.anchors[at] = AnchorInC(number, (I32 * 3)(*place_mm))
    return fix
