"""ROS 2 messages made from numbers and arrays, as `rosbags` types; no ROS installation needed."""

from __future__ import annotations

from typing import Any

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
