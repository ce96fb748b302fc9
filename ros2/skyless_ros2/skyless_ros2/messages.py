"""Messages of ROS 2 from Skyless's JSON lines (``skyless bridge jsonl+tcp:``), and lines from a robot's messages."""

import json
import math
from collections.abc import Iterable
from typing import Any

import numpy as np
from geometry_msgs.msg import PoseWithCovarianceStamped, TransformStamped, TwistWithCovarianceStamped
from nav_msgs.msg import Odometry
from numpy.typing import ArrayLike
from sensor_msgs.msg import Imu
from uwb_msgs.msg import Anchor, Anchors
from visualization_msgs.msg import Marker, MarkerArray

UNKNOWN_VARIANCE = 1e6
MIN_STD_M = 0.01
ANCHOR_SIZE_M = 0.15


def set_header(message: Any, unix_s: float, frame: str) -> None:
    """Set stamp, to the nearest nanosecond, and frame."""
    seconds = math.floor(unix_s)
    nanoseconds = round((unix_s - seconds) * 1e9)
    message.header.stamp.sec = seconds + nanoseconds // 1_000_000_000
    message.header.stamp.nanosec = nanoseconds % 1_000_000_000
    message.header.frame_id = frame


def seconds_of(message: Any) -> float:
    """The time of a message's stamp [s]."""
    return float(message.header.stamp.sec + message.header.stamp.nanosec * 1e-9)


def set_xyz(point: Any, values: Iterable[float]) -> None:
    """Set a point or vector."""
    point.x, point.y, point.z = map(float, values)


def yaw_of(q: Any) -> float:
    """The heading of an orientation [rad]."""
    return math.atan2(2.0 * (q.w * q.z + q.x * q.y), 1.0 - 2.0 * (q.y * q.y + q.z * q.z))


def floored(covariance: list[float]) -> list[float]:
    """With a variance of at least MIN_STD_M squared in each axis: the gates of filters reject honest millimetres."""
    return [max(float(one), MIN_STD_M**2) if place % 4 == 0 else float(one) for place, one in enumerate(covariance)]


def six_by_six(known: ArrayLike, axes: list[int]) -> list[float]:
    """A covariance of x, y, z and the angles about them, of which some axes are known; row by row."""
    whole = np.diag([0.0 if axis in axes else UNKNOWN_VARIANCE for axis in range(6)])
    whole[np.ix_(axes, axes)] = np.reshape(known, (len(axes), len(axes)))
    return whole.ravel().tolist()


def pose(
    unix_s: float, frame: str, place_m: Iterable[float], covariance: ArrayLike, axes: list[int], yaw_rad: float = 0.0
) -> PoseWithCovarianceStamped:
    """Where a tag or a robot is; the axes are those of the covariance, of six."""
    message = PoseWithCovarianceStamped()
    set_header(message, unix_s, frame)
    at = message.pose.pose
    set_xyz(at.position, place_m)
    at.orientation.z, at.orientation.w = math.sin(yaw_rad / 2.0), math.cos(yaw_rad / 2.0)
    message.pose.covariance = six_by_six(covariance, axes)
    return message


def set_orientation(message: PoseWithCovarianceStamped, fix: dict[str, Any]) -> None:
    """Turn a tag's pose, where a motion sensor of it shows how."""
    if fix.get("orientation") is not None:
        at = message.pose.pose.orientation
        at.w, at.x, at.y, at.z = fix["orientation"]
        for axis, std_rad in ((3, 0.045), (4, 0.045), (5, fix["heading_std_rad"])):
            message.pose.covariance[7 * axis] = std_rad**2


def velocity(fix: dict[str, Any], unix_s: float, frame: str) -> TwistWithCovarianceStamped | None:
    """How a tag moves, in the site's frame; None where that is not known."""
    if fix["velocity_mps"] is None or None in fix["velocity_mps"] + fix["velocity_covariance"]:
        return None
    message = TwistWithCovarianceStamped()
    set_header(message, unix_s, frame)
    set_xyz(message.twist.twist.linear, fix["velocity_mps"])
    message.twist.covariance = six_by_six(fix["velocity_covariance"], [0, 1, 2])
    return message


def transform(unix_s: float, frame: str, child: str, place_m: Iterable[float], yaw_rad: float) -> TransformStamped:
    """Where a frame is in another."""
    message = TransformStamped(child_frame_id=child)
    set_header(message, unix_s, frame)
    set_xyz(message.transform.translation, place_m)
    message.transform.rotation.z, message.transform.rotation.w = math.sin(yaw_rad / 2.0), math.cos(yaw_rad / 2.0)
    return message


def anchors(anchors_m: dict[str, list[float]], frame: str) -> tuple[Anchors, MarkerArray]:
    """Where the anchors are; for RViz a cube and its number for each, at any time."""
    found, markers = Anchors(), MarkerArray()
    found.header.frame_id = frame
    for number, (x, y, z) in anchors_m.items():
        anchor = Anchor(id=int(number), name=number)
        set_xyz(anchor.position, (x, y, z))
        anchor.covariance[0] = -1.0
        found.anchors.append(anchor)
        for kind, shape, height in (("anchors", Marker.CUBE, z), ("anchor_numbers", Marker.TEXT_VIEW_FACING, z + 0.3)):
            marker = Marker(ns=kind, id=int(number) % (1 << 31), type=shape, frame_locked=True)
            marker.header.frame_id = frame
            set_xyz(marker.pose.position, (x, y, height))
            set_xyz(marker.scale, [ANCHOR_SIZE_M] * 3)
            marker.color.r, marker.color.g, marker.color.a = 1.0, 0.6, 1.0
            marker.text = number if shape == Marker.TEXT_VIEW_FACING else ""
            markers.markers.append(marker)
    return found, markers


def motion_line(message: Imu | Odometry, *, has_unix_time: bool) -> bytes:
    """What ``skyless tag --motion`` reads; axes x forward, y left, z up.

    Raises ValueError where it is not finite, or not provided (REP 145).
    """
    if isinstance(message, Imu):
        if -1.0 in (message.angular_velocity_covariance[0], message.linear_acceleration_covariance[0]):
            raise ValueError
        rate, force = message.angular_velocity, message.linear_acceleration
        found = {"rate_rps": [rate.x, rate.y, rate.z], "force_mps2": [force.x, force.y, force.z]}
    else:
        found = {"speed_mps": message.twist.twist.linear.x, "rate_rps": message.twist.twist.angular.z}
    if has_unix_time:
        found["t_s"] = seconds_of(message)
    return json.dumps({"imu" if isinstance(message, Imu) else "wheels": found}, allow_nan=False).encode() + b"\n"
