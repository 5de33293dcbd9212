"""Estimates to messages. Setters of generated messages do not check types: every number is converted on the way in."""

from __future__ import annotations

import math

import numpy as np
from builtin_interfaces.msg import Duration as DurationMsg
from builtin_interfaces.msg import Time as TimeMsg
from geometry_msgs.msg import Point, Pose, PoseArray, PoseWithCovarianceStamped, Quaternion, Transform, Vector3
from sensor_msgs.msg import NavSatFix, NavSatStatus, PointCloud2, PointField
from std_msgs.msg import ColorRGBA, Header
from visualization_msgs.msg import Marker, MarkerArray

from crossloc3d_ros.formats.pointcloud2 import pack_columns
from crossloc3d_ros.geodesy import MapFrame
from crossloc3d_ros.types import Estimate, FixStatus, Float64Array

UNKNOWN_ANGLE_VARIANCE_RAD2 = 1.0e6
"""Retrieval tells where, not which way: so large a variance makes every filter ignore the angle."""
MARKER_LIFETIME_S = 5.0
UNKNOWN_HEIGHT_VARIANCE_M2 = 1e6


def stamp_message(stamp_ns: int) -> TimeMsg:
    """Return integer nanoseconds as a message."""
    return TimeMsg(sec=int(stamp_ns // 1_000_000_000), nanosec=int(stamp_ns % 1_000_000_000))


def header_message(stamp_ns: int, frame_id: str) -> Header:
    """Return a header."""
    return Header(stamp=stamp_message(stamp_ns), frame_id=frame_id)


def fix_message(estimate: Estimate, base_frame_id: str) -> NavSatFix:
    """Return the fix of `base_frame_id`; without one the position is NaN, so that nobody drives by a guess."""
    is_fix = estimate.status is FixStatus.FIX
    message = NavSatFix(
        header=header_message(estimate.stamp_ns, base_frame_id),
        status=NavSatStatus(
            status=NavSatStatus.STATUS_FIX if is_fix else NavSatStatus.STATUS_NO_FIX,
            service=0,  # no satellite system has a part in it
        ),
        latitude=float(estimate.latitude_deg) if is_fix else math.nan,
        longitude=float(estimate.longitude_deg) if is_fix else math.nan,
        altitude=float(estimate.altitude_m) if is_fix else math.nan,
        position_covariance_type=NavSatFix.COVARIANCE_TYPE_UNKNOWN,
    )
    if is_fix:
        covariance = estimate.covariance.copy()
        if math.isnan(estimate.altitude_m):  # whoever overlooks the NaN shall not take the height for known
            covariance[2, :] = covariance[:, 2] = 0.0
            covariance[2, 2] = UNKNOWN_HEIGHT_VARIANCE_M2
        message.position_covariance = [float(v) for v in covariance.flat]
        # Spread of the candidates on a floor, not an error that was measured for this very fix.
        message.position_covariance_type = NavSatFix.COVARIANCE_TYPE_APPROXIMATED
    return message


def origin_message(frame: MapFrame, stamp_ns: int, global_frame_id: str) -> NavSatFix:
    """Return where on Earth the origin of the ENU frame `global_frame_id` lies."""
    latitude, longitude, altitude = frame.to_geographic(np.asarray(frame.origin, dtype=np.float64)[None])
    return NavSatFix(
        header=header_message(stamp_ns, global_frame_id),
        status=NavSatStatus(status=NavSatStatus.STATUS_FIX, service=0),
        latitude=float(latitude[0]),
        longitude=float(longitude[0]),
        altitude=float(altitude[0]),
        position_covariance_type=NavSatFix.COVARIANCE_TYPE_UNKNOWN,
    )


def pose_message(estimate: Estimate, global_frame_id: str) -> PoseWithCovarianceStamped:
    """Return the position in the map frame; the orientation is unknown and its variance says so."""
    message = PoseWithCovarianceStamped(header=header_message(estimate.stamp_ns, global_frame_id))
    message.pose.pose = _pose(estimate.enu)
    covariance = np.zeros((6, 6))
    covariance[:3, :3] = estimate.covariance
    covariance[3:, 3:] = np.eye(3) * UNKNOWN_ANGLE_VARIANCE_RAD2
    message.pose.covariance = [float(v) for v in covariance.flat]
    return message


def candidates_message(estimate: Estimate, enu: Float64Array, global_frame_id: str) -> PoseArray:
    """Return the candidates' positions `enu` (k, 3), best first."""
    header = header_message(estimate.stamp_ns, global_frame_id)
    return PoseArray(header=header, poses=[_pose(position) for position in enu])


def candidate_table_message(
    estimate: Estimate, enu: Float64Array, latitude: Float64Array, longitude: Float64Array, global_frame_id: str
) -> PointCloud2:
    """Return the candidates, best first, with all that is known of each; `enu` (k, 3), the others (k,)."""
    candidates = estimate.candidates
    packed = pack_columns(
        {
            "x": enu[:, 0].astype(np.float32),
            "y": enu[:, 1].astype(np.float32),
            "z": enu[:, 2].astype(np.float32),
            "latitude": np.asarray(latitude, dtype=np.float64),
            "longitude": np.asarray(longitude, dtype=np.float64),
            "descriptor_distance": candidates.descriptor_distances.astype(np.float32),
            "probability": candidates.probabilities.astype(np.float32),
            "submap_id": candidates.submap_ids.astype(np.int32),
        }
    )
    return PointCloud2(
        header=header_message(estimate.stamp_ns, global_frame_id),
        height=1,
        width=len(candidates),
        fields=[PointField(name=n, offset=o, datatype=d, count=c) for n, o, d, c in packed.fields],
        is_bigendian=False,
        point_step=packed.point_step,
        row_step=packed.point_step * len(candidates),
        data=packed.data,
        is_dense=True,
    )


def markers_message(estimate: Estimate, enu: Float64Array, global_frame_id: str) -> MarkerArray:
    """Return the picture for RViz: candidates as columns as high as their probability, the estimate as its ellipse."""
    header = header_message(estimate.stamp_ns, global_frame_id)
    markers = [Marker(header=header, ns="candidates", action=Marker.DELETEALL)]
    for number, (position, probability) in enumerate(zip(enu, estimate.candidates.probabilities, strict=True)):
        height_m = 2.0 + 100.0 * float(probability)
        marker = _marker(header, "candidates", number, Marker.CYLINDER, _above(position, height_m / 2.0))
        marker.scale = Vector3(x=6.0, y=6.0, z=height_m)
        marker.color = _color(1.0, 0.6, 0.0, 0.25 + 0.75 * float(probability))
        markers.append(marker)
    if np.isfinite(estimate.enu).all():
        is_fix = estimate.status is FixStatus.FIX
        variances, axes = np.linalg.eigh(estimate.covariance[:2, :2])
        ellipse = _marker(header, "estimate", 0, Marker.CYLINDER, estimate.enu)
        yaw = math.atan2(float(axes[1, 1]), float(axes[0, 1]))
        ellipse.pose.orientation = Quaternion(x=0.0, y=0.0, z=math.sin(yaw / 2.0), w=math.cos(yaw / 2.0))
        ellipse.scale = Vector3(x=4.0 * math.sqrt(variances[1]), y=4.0 * math.sqrt(variances[0]), z=1.0)
        ellipse.color = _color(0.1, 0.8, 0.2, 0.4) if is_fix else _color(0.8, 0.1, 0.1, 0.25)
        markers.append(ellipse)
    # Where nothing is known, the reason stands at the map's origin.
    text = _marker(header, "reason", 0, Marker.TEXT_VIEW_FACING, _above(np.nan_to_num(estimate.enu), 40.0))
    text.scale.z = 8.0
    text.color = _color(1.0, 1.0, 1.0, 1.0)
    text.text = estimate.reason
    markers.append(text)
    return MarkerArray(markers=markers)


def matrix_from_transform(transform: Transform) -> Float64Array:
    """Return a transform message as a homogeneous matrix (4, 4)."""
    q, t = transform.rotation, transform.translation
    w, x, y, z = np.array([q.w, q.x, q.y, q.z]) / math.sqrt(q.w**2 + q.x**2 + q.y**2 + q.z**2)
    return np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w), t.x],
            [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w), t.y],
            [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y), t.z],
            [0.0, 0.0, 0.0, 1.0],
        ]
    )


def _pose(enu: Float64Array) -> Pose:
    position = Point(x=float(enu[0]), y=float(enu[1]), z=float(enu[2]))
    return Pose(position=position, orientation=Quaternion(x=0.0, y=0.0, z=0.0, w=1.0))


def _above(enu: Float64Array, height_m: float) -> Float64Array:
    return np.asarray(enu + np.array([0.0, 0.0, height_m]))


def _marker(header: Header, namespace: str, number: int, kind: int, position: Float64Array) -> Marker:
    return Marker(
        header=header,
        ns=namespace,
        id=number,
        type=int(kind),
        action=Marker.ADD,
        pose=_pose(position),
        lifetime=DurationMsg(sec=int(MARKER_LIFETIME_S), nanosec=0),
    )


def _color(red: float, green: float, blue: float, alpha: float) -> ColorRGBA:
    return ColorRGBA(r=float(red), g=float(green), b=float(blue), a=min(1.0, float(alpha)))
