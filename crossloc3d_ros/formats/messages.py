"""ROS 2 messages made from numbers and arrays, as `rosbags` types; no ROS installation needed."""

from __future__ import annotations

from typing import Any, Literal

import numpy as np
import numpy.typing as npt
from rosbags.typesys.stores.ros2_dashing import sensor_msgs__msg__NavSatStatus as NavSatStatus
from rosbags.typesys.stores.ros2_jazzy import builtin_interfaces__msg__Time as Time
from rosbags.typesys.stores.ros2_jazzy import geometry_msgs__msg__Point as Point
from rosbags.typesys.stores.ros2_jazzy import geometry_msgs__msg__Pose as Pose
from rosbags.typesys.stores.ros2_jazzy import geometry_msgs__msg__PoseStamped as PoseStamped
from rosbags.typesys.stores.ros2_jazzy import geometry_msgs__msg__PoseWithCovariance as PoseWithCovariance
from rosbags.typesys.stores.ros2_jazzy import geometry_msgs__msg__Quaternion as Quaternion
from rosbags.typesys.stores.ros2_jazzy import geometry_msgs__msg__Twist as Twist
from rosbags.typesys.stores.ros2_jazzy import geometry_msgs__msg__TwistWithCovariance as TwistWithCovariance
from rosbags.typesys.stores.ros2_jazzy import geometry_msgs__msg__Vector3 as Vector3
from rosbags.typesys.stores.ros2_jazzy import nav_msgs__msg__Odometry as Odometry
from rosbags.typesys.stores.ros2_jazzy import sensor_msgs__msg__Imu as Imu
from rosbags.typesys.stores.ros2_jazzy import sensor_msgs__msg__NavSatFix as NavSatFix
from rosbags.typesys.stores.ros2_jazzy import sensor_msgs__msg__PointCloud2 as PointCloud2
from rosbags.typesys.stores.ros2_jazzy import sensor_msgs__msg__PointField as PointField
from rosbags.typesys.stores.ros2_jazzy import std_msgs__msg__Header as Header

from crossloc3d_ros.errors import BagError
from crossloc3d_ros.formats.pointcloud2 import POINT_FIELD_NUMBERS

# What Velodyne's driver sends: 22 bytes a point.
VELODYNE_POINT = np.dtype(
    {
        "names": ["x", "y", "z", "intensity", "ring", "time"],
        "formats": ["<f4", "<f4", "<f4", "<f4", "<u2", "<f4"],
        "offsets": [0, 4, 8, 12, 16, 18],
        "itemsize": 22,
    }
)

# What Ouster's driver sends by default: aligned for PCL, 48 bytes a point; `t` in nanoseconds from the stamp.
OUSTER_POINT = np.dtype(
    {
        "names": ["x", "y", "z", "intensity", "t", "reflectivity", "ring", "ambient", "range"],
        "formats": ["<f4", "<f4", "<f4", "<f4", "<u4", "<u2", "<u2", "<u2", "<u4"],
        "offsets": [0, 4, 8, 16, 20, 24, 26, 28, 32],
        "itemsize": 48,
    }
)
# What Hesai's driver sends: 26 bytes a point; `timestamp` in seconds since 1970.
HESAI_POINT = np.dtype(
    {
        "names": ["x", "y", "z", "intensity", "ring", "timestamp"],
        "formats": ["<f4", "<f4", "<f4", "<f4", "<u2", "<f8"],
        "offsets": [0, 4, 8, 12, 16, 18],
        "itemsize": 26,
    }
)
# Livox's custom message as a cloud: `offset_time` in nanoseconds from the stamp.
LIVOX_POINT = np.dtype(
    {
        "names": ["x", "y", "z", "intensity", "tag", "line", "offset_time"],
        "formats": ["<f4", "<f4", "<f4", "<f4", "u1", "u1", "<u4"],
        "offsets": [0, 4, 8, 12, 16, 17, 18],
        "itemsize": 22,
    }
)
CloudLayout = Literal["velodyne", "ouster", "hesai", "livox"]
"""Whose driver lays out a cloud."""


def lidar_cloud(
    layout: CloudLayout,
    stamp_ns: int,
    frame_id: str,
    points: npt.ArrayLike,
    intensity: npt.ArrayLike,
    ring: npt.ArrayLike,
    time_s: npt.ArrayLike,
) -> PointCloud2:
    """Build the PointCloud2 of a maker's driver: its fields, types and offsets.

    `points` (N, 3) metres in the lidar frame; `intensity`, `ring`, `time_s` (N,), time relative to the stamp. What
    `ouster` and `livox` would have before it is sent as at the stamp: their times have no sign.
    """
    if layout == "velodyne":
        return velodyne_cloud(stamp_ns, frame_id, points, intensity, ring, time_s)
    xyz = np.asarray(points, dtype=np.float32).reshape(-1, 3)
    kind = {"ouster": OUSTER_POINT, "hesai": HESAI_POINT, "livox": LIVOX_POINT}[layout]
    table = np.zeros(len(xyz), dtype=kind)
    table["x"], table["y"], table["z"] = xyz.T
    table["intensity"] = intensity
    since_stamp_ns = np.rint(np.asarray(time_s, dtype=np.float64) * 1e9).astype(np.int64)
    if layout == "hesai":
        table["ring"], table["timestamp"] = ring, (stamp_ns + since_stamp_ns) * 1e-9
    elif layout == "ouster":
        table["ring"], table["t"], table["reflectivity"] = ring, np.maximum(since_stamp_ns, 0), intensity
        table["range"] = np.rint(1e3 * np.linalg.norm(xyz, axis=1))
    else:
        table["line"], table["offset_time"] = ring, np.maximum(since_stamp_ns, 0)
    return structured_cloud(stamp_ns, frame_id, table)


def velodyne_cloud(
    stamp_ns: int,
    frame_id: str,
    points: npt.ArrayLike,
    intensity: npt.ArrayLike,
    ring: npt.ArrayLike,
    time_s: npt.ArrayLike,
) -> PointCloud2:
    """Build the PointCloud2 that Velodyne's driver sends: x y z intensity ring time, 22 bytes a point.

    `points` (N, 3) metres in the lidar frame; `intensity`, `ring`, `time_s` (N,), time relative to the stamp.
    """
    xyz = np.asarray(points, dtype=np.float32).reshape(-1, 3)
    table = np.empty(len(xyz), dtype=VELODYNE_POINT)
    table["x"], table["y"], table["z"] = xyz.T
    table["intensity"], table["ring"], table["time"] = intensity, ring, time_s
    return structured_cloud(stamp_ns, frame_id, table)


def structured_cloud(stamp_ns: int, frame_id: str, table: npt.NDArray[Any]) -> PointCloud2:
    """Build a PointCloud2, one row high, from a structured array (N,): its fields, offsets and byte order are kept."""
    fields = [
        PointField(
            name,
            int(offset),
            POINT_FIELD_NUMBERS[kind.base.newbyteorder("=")],
            int(np.prod(kind.shape, dtype=int)) or 1,
        )
        for name, (kind, offset, *_) in _structured_fields(table.dtype).items()
    ]
    big_endian = any(kind.base.str[0] == ">" for kind, *_ in _structured_fields(table.dtype).values())
    data = np.frombuffer(np.ascontiguousarray(table).tobytes(), dtype=np.uint8)
    return PointCloud2(
        header=header(stamp_ns, frame_id),
        height=1,
        width=len(table),
        fields=fields,
        is_bigendian=big_endian,
        point_step=table.dtype.itemsize,
        row_step=table.dtype.itemsize * len(table),
        data=data,
        is_dense=True,
    )


def nav_sat_fix(
    stamp_ns: int,
    frame_id: str,
    latitude_deg: float,
    longitude_deg: float,
    altitude_m: float,
    covariance: npt.ArrayLike | None = None,
    *,
    has_fix: bool = True,
) -> NavSatFix:
    """Build a NavSatFix; WGS84 ellipsoidal height, `covariance` (3, 3) ENU in square metres or None for unknown."""
    matrix = np.zeros(9) if covariance is None else np.asarray(covariance, dtype=np.float64).reshape(9).copy()
    status = NavSatStatus(NavSatStatus.STATUS_FIX if has_fix else NavSatStatus.STATUS_NO_FIX, NavSatStatus.SERVICE_GPS)
    return NavSatFix(
        header=header(stamp_ns, frame_id),
        status=status,
        latitude=float(latitude_deg),
        longitude=float(longitude_deg),
        altitude=float(altitude_m),
        position_covariance=matrix,
        position_covariance_type=(
            NavSatFix.COVARIANCE_TYPE_UNKNOWN if covariance is None else NavSatFix.COVARIANCE_TYPE_KNOWN
        ),
    )


def odometry(
    stamp_ns: int,
    frame_id: str,
    child_frame_id: str,
    position_m: npt.ArrayLike,
    orientation_xyzw: npt.ArrayLike,
    linear_m_s: npt.ArrayLike = (0.0, 0.0, 0.0),
    angular_rad_s: npt.ArrayLike = (0.0, 0.0, 0.0),
    pose_covariance: npt.ArrayLike | None = None,
    twist_covariance: npt.ArrayLike | None = None,
) -> Odometry:
    """Build an Odometry: pose of the child frame in `frame_id`, velocity in the child frame, covariances (6, 6)."""
    return Odometry(
        header=header(stamp_ns, frame_id),
        child_frame_id=child_frame_id,
        pose=PoseWithCovariance(_pose(position_m, orientation_xyzw), _covariance(pose_covariance, 36)),
        twist=TwistWithCovariance(
            Twist(_vector(linear_m_s), _vector(angular_rad_s)), _covariance(twist_covariance, 36)
        ),
    )


def imu(
    stamp_ns: int,
    frame_id: str,
    angular_rad_s: npt.ArrayLike,
    acceleration_m_s2: npt.ArrayLike,
    orientation_xyzw: npt.ArrayLike | None = None,
) -> Imu:
    """Build an Imu; at rest and upright the acceleration is (0, 0, +9.81). No orientation: covariance[0] is -1."""
    orientation_covariance = np.zeros(9)
    if orientation_xyzw is None:
        orientation_covariance[0] = -1.0
    return Imu(
        header=header(stamp_ns, frame_id),
        orientation=_quaternion((0.0, 0.0, 0.0, 1.0) if orientation_xyzw is None else orientation_xyzw),
        orientation_covariance=orientation_covariance,
        angular_velocity=_vector(angular_rad_s),
        angular_velocity_covariance=np.zeros(9),
        linear_acceleration=_vector(acceleration_m_s2),
        linear_acceleration_covariance=np.zeros(9),
    )


def pose_stamped(
    stamp_ns: int, frame_id: str, position_m: npt.ArrayLike, orientation_xyzw: npt.ArrayLike
) -> PoseStamped:
    """Build a PoseStamped."""
    return PoseStamped(header=header(stamp_ns, frame_id), pose=_pose(position_m, orientation_xyzw))


def header(stamp_ns: int, frame_id: str) -> Header:
    """Build a Header."""
    seconds, nanoseconds = divmod(int(stamp_ns), 1_000_000_000)
    return Header(stamp=Time(seconds, nanoseconds), frame_id=frame_id)


def _structured_fields(dtype: np.dtype[Any]) -> dict[str, Any]:
    if dtype.fields is None:
        raise BagError(f"a cloud needs a structured array, got dtype {dtype}")
    return dict(dtype.fields)


def _vector(values: npt.ArrayLike) -> Vector3:
    x, y, z = np.asarray(values, dtype=np.float64).tolist()
    return Vector3(x, y, z)


def _quaternion(xyzw: npt.ArrayLike) -> Quaternion:
    x, y, z, w = np.asarray(xyzw, dtype=np.float64).tolist()
    return Quaternion(x, y, z, w)


def _pose(position_m: npt.ArrayLike, orientation_xyzw: npt.ArrayLike) -> Pose:
    x, y, z = np.asarray(position_m, dtype=np.float64).tolist()
    return Pose(Point(x, y, z), _quaternion(orientation_xyzw))


def _covariance(values: npt.ArrayLike | None, size: int) -> npt.NDArray[np.float64]:
    return np.zeros(size) if values is None else np.asarray(values, dtype=np.float64).reshape(size).copy()
