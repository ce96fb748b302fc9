"""A fix as it is published."""

from skyless.mqtt.messages import FixMessage, Matrix, Vector
from skyless.positioning.fix import Fix


def fix_message(tag: str, serial: int, fix: Fix, unix_s: float, latency_s: float) -> FixMessage:
    """The message of a fix; ``unix_s`` is the end of its last frame."""
    dops = fix.dops
    moving = fix.velocity_mps is not None and fix.velocity_covariance is not None
    return FixMessage(
        tag=tag,
        serial=serial,
        unix_s=unix_s,
        time_s=fix.time_s,
        position_m=_vector(fix.position_m.tolist()),
        covariance_m2=_matrix(fix.covariance_m2.ravel().tolist()),
        velocity_mps=_vector(fix.velocity_mps.tolist()) if moving else None,  # type: ignore[union-attr]
        velocity_covariance=_matrix(fix.velocity_covariance.ravel().tolist()) if moving else None,  # type: ignore[union-attr]
        std_m=fix.std_m,
        gdop=dops.gdop,
        pdop=dops.pdop,
        hdop=dops.hdop,
        vdop=dops.vdop,
        anchors=fix.anchors,
        chi2=fix.chi2,
        dof=fix.dof,
        residual_rms_m=fix.residual_rms_m,
        method=fix.method,
        height_known=fix.height_known,
        latency_s=latency_s,
        hpl_m=fix.hpl_m,
        vpl_m=fix.vpl_m,
        integrity_risk=fix.integrity_risk,
        alert=None if fix.alert is None else fix.alert.value,
        verified_until_s=fix.verified_until_s,
        unverified=fix.unverified,
    )


def _vector(values: list[float]) -> Vector:
    x, y, z = values
    return x, y, z


def _matrix(values: list[float]) -> Matrix:
    xx, xy, xz, yx, yy, yz, zx, zy, zz = values
    return xx, xy, xz, yx, yy, yz, zx, zy, zz
