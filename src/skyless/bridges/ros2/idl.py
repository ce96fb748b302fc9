"""Types of ROS 2's messages as Cyclone DDS announces them, so that subscribers of any vendor find them equal to theirs.

Names as ROS gives them in DDS: ``package::msg::dds_::Name_``.
"""

from importlib import import_module
from typing import Any, Final

from skyless.bridges.ros2 import messages

idl: Final[Any] = import_module("cyclonedds.idl.types")  # by name, as there are machines without it


def _struct(ros_name: str, **fields: Any) -> Any:  # noqa: ANN401 - a class whose fields only DDS sees
    package, kind, name = ros_name.split("/")
    return import_module("cyclonedds.idl").make_idl_struct(name, f"{package}.{kind}.dds_.{name}_", fields)


def _array(length: int) -> object:
    return idl.array[idl.float64, length]


def _doubles(names: str) -> dict[str, object]:
    return dict.fromkeys(names, idl.float64)


_TIME: Final = _struct("builtin_interfaces/msg/Time", sec=idl.int32, nanosec=idl.uint32)
_DURATION: Final = _struct("builtin_interfaces/msg/Duration", sec=idl.int32, nanosec=idl.uint32)
_HEADER: Final = _struct("std_msgs/msg/Header", stamp=_TIME, frame_id=str)
_POINT: Final = _struct("geometry_msgs/msg/Point", **_doubles("xyz"))
_VECTOR: Final = _struct("geometry_msgs/msg/Vector3", **_doubles("xyz"))
_QUATERNION: Final = _struct("geometry_msgs/msg/Quaternion", **_doubles("xyzw"))

_POSE: Final = _struct("geometry_msgs/msg/Pose", position=_POINT, orientation=_QUATERNION)
_POSE_WITH_COVARIANCE: Final = _struct("geometry_msgs/msg/PoseWithCovariance", pose=_POSE, covariance=_array(36))
_TWIST: Final = _struct("geometry_msgs/msg/Twist", linear=_VECTOR, angular=_VECTOR)
_TWIST_WITH_COVARIANCE: Final = _struct("geometry_msgs/msg/TwistWithCovariance", twist=_TWIST, covariance=_array(36))
_SATELLITE_STATUS: Final = _struct("sensor_msgs/msg/NavSatStatus", status=idl.int8, service=idl.uint16)
_TRANSFORM: Final = _struct("geometry_msgs/msg/Transform", translation=_VECTOR, rotation=_QUATERNION)
_TRANSFORM_STAMPED: Final = _struct(
    "geometry_msgs/msg/TransformStamped", header=_HEADER, child_frame_id=str, transform=_TRANSFORM
)
_KEY_VALUE: Final = _struct("diagnostic_msgs/msg/KeyValue", key=str, value=str)
_DIAGNOSTIC_STATUS: Final = _struct(
    "diagnostic_msgs/msg/DiagnosticStatus",
    level=idl.uint8,
    name=str,
    message=str,
    hardware_id=str,
    values=idl.sequence[_KEY_VALUE],
)
_COLOUR: Final = _struct("std_msgs/msg/ColorRGBA", **dict.fromkeys("rgba", idl.float32))
_IMAGE: Final = _struct("sensor_msgs/msg/CompressedImage", header=_HEADER, format=str, data=idl.sequence[idl.uint8])
_UV: Final = _struct("visualization_msgs/msg/UVCoordinate", u=idl.float32, v=idl.float32)
_MESH: Final = _struct("visualization_msgs/msg/MeshFile", filename=str, data=idl.sequence[idl.uint8])
_MARKER: Final = _struct(
    "visualization_msgs/msg/Marker",
    header=_HEADER,
    ns=str,
    id=idl.int32,
    type=idl.int32,
    action=idl.int32,
    pose=_POSE,
    scale=_VECTOR,
    color=_COLOUR,
    lifetime=_DURATION,
    frame_locked=bool,
    points=idl.sequence[_POINT],
    colors=idl.sequence[_COLOUR],
    texture_resource=str,
    texture=_IMAGE,
    uv_coordinates=idl.sequence[_UV],
    text=str,
    mesh_resource=str,
    mesh_file=_MESH,
    mesh_use_embedded_materials=bool,
)

TYPES: Final[dict[str, Any]] = {
    messages.POSE.name: _struct(messages.POSE.name, header=_HEADER, pose=_POSE_WITH_COVARIANCE),
    messages.TWIST.name: _struct(messages.TWIST.name, header=_HEADER, twist=_TWIST_WITH_COVARIANCE),
    messages.NAV_SAT_FIX.name: _struct(
        messages.NAV_SAT_FIX.name,
        header=_HEADER,
        status=_SATELLITE_STATUS,
        latitude=idl.float64,
        longitude=idl.float64,
        altitude=idl.float64,
        position_covariance=_array(9),
        position_covariance_type=idl.uint8,
    ),
    messages.DIAGNOSTICS.name: _struct(
        messages.DIAGNOSTICS.name, header=_HEADER, status=idl.sequence[_DIAGNOSTIC_STATUS]
    ),
    messages.TRANSFORMS.name: _struct(messages.TRANSFORMS.name, transforms=idl.sequence[_TRANSFORM_STAMPED]),
    messages.MARKERS.name: _struct(messages.MARKERS.name, markers=idl.sequence[_MARKER]),
}
"""Types that are published, by their names in ROS."""
