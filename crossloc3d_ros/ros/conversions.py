"""Estimates to messages. Setters of generated messages do not check types: every number is converted on the way in."""

from __future__ import annotations

import math
from collections.abc import Mapping

import numpy as np
from builtin_interfaces.msg import Duration as DurationMsg
from builtin_interfaces.msg import Time as TimeMsg
from diagnostic_msgs.msg import DiagnosticStatus, KeyValue
from geometry_msgs.msg import (
    Point,
    Pose,
    PoseArray,
    PoseWithCovarianceStamped,
    Quaternion,
    Transform,
    TransformStamped,
    Vector3,
)
from scipy.spatial.transform import Rotation
from sensor_msgs.msg import NavSatFix, NavSatStatus, PointCloud2, PointField
from std_msgs.msg import ColorRGBA, Header
from visualization_msgs.msg import Marker, MarkerArray

from crossloc3d_ros.formats.odometry import pose_matrix
from crossloc3d_ros.formats.pointcloud2 import PackedCloud, pack_columns
from crossloc3d_ros.geodesy import MapFrame
from crossloc3d_ros.types import Estimate, FixStatus, Float64Array, Hypotheses, Int64Array, TrackState

UNKNOWN_ANGLE_VARIANCE_RAD2 = 1.0e6
"""Where a place is known and no heading: so large a variance makes every filter ignore the angle."""
MARKER_LIFETIME_S = 5.0
UNKNOWN_HEIGHT_VARIANCE_M2 = 1e6


def stamp_message(stamp_ns: int) -> TimeMsg:
    """Return integer nanoseconds as a message."""
    return TimeMsg(sec=int(stamp_ns // 1_000_000_000), nanosec=int(stamp_ns % 1_000_000_000))


def header_message(stamp_ns: int, frame_id: str) -> Header:
    """Return a header."""
    return Header(stamp=stamp_message(stamp_ns), frame_id=frame_id)


def fix_message(estimate: Estimate, base_frame_id: str) -> NavSatFix:
    """Return the fix of `base_frame_id`; without one the position is NaN, so that it cannot be taken for a fix."""
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
        # Fitted on known places, not an error that was measured for this very fix.
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
    """Return the pose in the map frame; where the orientation is unknown its variance is large."""
    message = PoseWithCovarianceStamped(header=header_message(estimate.stamp_ns, global_frame_id))
    if np.isfinite(estimate.T_map_base).all():
        message.pose.pose = pose_of_matrix(estimate.T_map_base)
    else:
        message.pose.pose = _pose(estimate.enu)
    covariance = estimate.pose_covariance
    if not np.isfinite(covariance).all():
        covariance = np.zeros((6, 6))
        covariance[:3, :3] = estimate.covariance
        covariance[3:, 3:] = np.eye(3) * UNKNOWN_ANGLE_VARIANCE_RAD2
    message.pose.covariance = [float(v) for v in covariance.flat]
    return message


STATE_LEVELS: Mapping[TrackState, bytes] = {
    TrackState.SEARCHING: DiagnosticStatus.WARN,
    TrackState.AMBIGUOUS: DiagnosticStatus.WARN,
    TrackState.LOCALIZED: DiagnosticStatus.OK,
    TrackState.LOST: DiagnosticStatus.ERROR,
}


def state_values(estimate: Estimate) -> dict[str, str]:
    """Return the state of localization as texts."""
    values = {
        "state": estimate.state.value,
        "fix": "yes" if estimate.status is FixStatus.FIX else "no",
        "probability": f"{estimate.probability:.6g}",
        "hypotheses": " ".join(f"{p:.4g}" for p in estimate.hypotheses.probabilities),
    }
    if np.isfinite(estimate.pose_covariance).all():
        east, north, yaw = (math.sqrt(max(0.0, float(estimate.pose_covariance[i, i]))) for i in (0, 1, 5))
        values["deviation (m, m, deg)"] = f"{east:.2f} {north:.2f} {math.degrees(yaw):.2f}"
    return values


def state_message(estimate: Estimate, name: str) -> DiagnosticStatus:
    """Return state and reason; `stamp_ns` among the values is that of the scan."""
    level = STATE_LEVELS[estimate.state]
    if estimate.status is not FixStatus.FIX:
        level = max(level, DiagnosticStatus.WARN)
    values = {"stamp_ns": str(estimate.stamp_ns), **state_values(estimate)}
    return _status(level, name, f"{estimate.state.value}: {estimate.reason}", values)


def stale_message(state: TrackState, reason: str, name: str) -> DiagnosticStatus:
    """Return that `state` is what was known last, and why nothing newer is."""
    return _status(DiagnosticStatus.STALE, name, f"{state.value} when last seen: {reason}", {"state": state.value})


def _status(level: bytes, name: str, message: str, values: Mapping[str, str]) -> DiagnosticStatus:
    pairs = [KeyValue(key=key, value=value) for key, value in values.items()]
    return DiagnosticStatus(level=level, name=name, message=message, values=pairs)


def hypotheses_message(estimate: Estimate, frame: MapFrame, global_frame_id: str) -> PoseArray:
    """Return the poses that the robot may have, likeliest first."""
    hypotheses: Hypotheses = estimate.hypotheses
    header = header_message(estimate.stamp_ns, global_frame_id)
    enu, yaw = in_map(frame, hypotheses.grid, hypotheses.heading_rad)
    return PoseArray(header=header, poses=[_pose(p, float(a)) for p, a in zip(enu, yaw, strict=True)])


def in_map(frame: MapFrame, grid: Float64Array, heading_rad: Float64Array) -> tuple[Float64Array, Float64Array]:
    """Return positions (n, 3) and yaws (n,) in the map frame of poses in the grid: (n, 3), and (n,) from grid east."""
    if len(grid) == 0:
        return np.empty((0, 3)), np.empty(0)
    ahead = grid + np.column_stack([np.cos(heading_rad), np.sin(heading_rad), np.zeros(len(grid))])
    enu = frame.to_enu(grid)
    direction = frame.to_enu(ahead) - enu
    return enu, np.arctan2(direction[:, 1], direction[:, 0])


def in_grid(frame: MapFrame, enu: Float64Array, yaw_rad: Float64Array) -> tuple[Float64Array, Float64Array]:
    """Return positions (n, 3) and headings (n,), from grid east, of poses in the map frame: (n, 3) and yaws (n,)."""
    if len(enu) == 0:
        return np.empty((0, 3)), np.empty(0)
    ahead = enu + np.column_stack([np.cos(yaw_rad), np.sin(yaw_rad), np.zeros(len(enu))])
    grid = frame.from_enu(enu)
    direction = frame.from_enu(ahead) - grid
    return grid, np.arctan2(direction[:, 1], direction[:, 0])


def candidates_message(estimate: Estimate, frame: MapFrame, global_frame_id: str) -> PoseArray:
    """Return the candidates' positions, best first."""
    header = header_message(estimate.stamp_ns, global_frame_id)
    enu = frame.to_enu(estimate.candidates.grid) if len(estimate.candidates) else np.empty((0, 3))
    return PoseArray(header=header, poses=[_pose(position) for position in enu])


def candidate_table_message(estimate: Estimate, frame: MapFrame, global_frame_id: str) -> PointCloud2:
    """Return the candidates, best first, with all that is known of each.

    `aligned_*` is the pose at which the scan fits best around the candidate, in the map frame, and its probability
    from this scan alone; NaN where it fits nowhere.
    """
    candidates = estimate.candidates
    known = len(candidates) > 0
    enu: Float64Array = frame.to_enu(candidates.grid) if known else np.empty((0, 3))
    latitude, longitude, _ = frame.to_geographic(candidates.grid) if known else (np.empty(0),) * 3
    rows = best_aligned(estimate)
    found = rows >= 0
    aligned, yaw = in_map(frame, estimate.aligned.grid[rows[found]], estimate.aligned.heading_rad[rows[found]])
    pose = np.full((len(candidates), 4), np.nan, np.float32)
    pose[found] = np.column_stack([aligned[:, :2], yaw, estimate.aligned.probabilities[rows[found]]])
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
            "aligned_x": pose[:, 0],
            "aligned_y": pose[:, 1],
            "aligned_yaw": pose[:, 2],
            "aligned_probability": pose[:, 3],
        }
    )
    return _cloud_message(header_message(estimate.stamp_ns, global_frame_id), packed, len(candidates))


def _cloud_message(header: Header, packed: PackedCloud, count: int) -> PointCloud2:
    return PointCloud2(
        header=header,
        height=1,
        width=count,
        fields=[PointField(name=n, offset=o, datatype=d, count=c) for n, o, d, c in packed.fields],
        is_bigendian=False,
        point_step=packed.point_step,
        row_step=packed.point_step * count,
        data=packed.data,
        is_dense=True,
    )


def best_aligned(estimate: Estimate) -> Int64Array:
    """Return for each candidate the row (k,) of its likeliest aligned pose, -1 where it has none."""
    rows = np.full(len(estimate.candidates), -1, np.int64)
    aligned = estimate.aligned
    for row in np.argsort(aligned.probabilities, kind="stable"):  # the likeliest is written last
        source = int(aligned.source[row])
        if 0 <= source < len(rows):
            rows[source] = row
    return rows


def markers_message(estimate: Estimate, frame: MapFrame, global_frame_id: str) -> MarkerArray:
    """Return the picture for RViz: candidates as columns as high as their probability, hypotheses as arrows as opaque
    as theirs, the estimate as its ellipse."""
    header = header_message(estimate.stamp_ns, global_frame_id)
    enu: Float64Array = frame.to_enu(estimate.candidates.grid) if len(estimate.candidates) else np.empty((0, 3))
    markers = [Marker(header=header, ns="candidates", action=Marker.DELETEALL)]
    for number, (position, probability) in enumerate(zip(enu, estimate.candidates.probabilities, strict=True)):
        height_m = 2.0 + 100.0 * float(probability)
        marker = _marker(header, "candidates", number, Marker.CYLINDER, _above(position, height_m / 2.0))
        marker.scale = Vector3(x=6.0, y=6.0, z=height_m)
        marker.color = _color(1.0, 0.6, 0.0, 0.25 + 0.75 * float(probability))
        markers.append(marker)
    hypotheses = estimate.hypotheses
    for number, (place, yaw) in enumerate(zip(*in_map(frame, hypotheses.grid, hypotheses.heading_rad), strict=True)):
        arrow = _marker(header, "hypotheses", number, Marker.ARROW, _above(place, 2.0), float(yaw))
        arrow.scale = Vector3(x=12.0, y=2.0, z=2.0)
        arrow.color = _color(0.2, 0.5, 1.0, 0.15 + 0.85 * float(hypotheses.probabilities[number]))
        markers.append(arrow)
    if np.isfinite(estimate.enu).all():
        is_fix = estimate.status is FixStatus.FIX
        variances, axes = np.linalg.eigh(estimate.covariance[:2, :2])
        along = math.atan2(float(axes[1, 1]), float(axes[0, 1]))
        ellipse = _marker(header, "estimate", 0, Marker.CYLINDER, estimate.enu, along)
        lengths = [max(0.2, 4.0 * math.sqrt(max(0.0, float(v)))) for v in variances]  # RViz draws none of no length
        ellipse.scale = Vector3(x=lengths[1], y=lengths[0], z=1.0)
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
    """Return a transform message as a homogeneous matrix (4, 4); PoseError where it is none."""
    t = transform.translation
    return pose_matrix(Pose(position=Point(x=t.x, y=t.y, z=t.z), orientation=transform.rotation))


def pose_of_matrix(T: Float64Array) -> Pose:
    """Return a rigid motion (4, 4) as a pose."""
    x, y, z, w = (float(v) for v in Rotation.from_matrix(T[:3, :3]).as_quat())
    pose = _pose(T[:3, 3])
    pose.orientation = Quaternion(x=x, y=y, z=z, w=w)
    return pose


def transform_message(T: Float64Array, stamp_ns: int, frame_id: str, child_frame_id: str) -> TransformStamped:
    """Return the pose (4, 4) of `child_frame_id` in `frame_id` as a transform."""
    pose = pose_of_matrix(T)
    message = TransformStamped(header=header_message(stamp_ns, frame_id), child_frame_id=child_frame_id)
    p = pose.position
    message.transform = Transform(translation=Vector3(x=p.x, y=p.y, z=p.z), rotation=pose.orientation)
    return message


def _pose(enu: Float64Array, yaw_rad: float = 0.0) -> Pose:
    position = Point(x=float(enu[0]), y=float(enu[1]), z=float(enu[2]))
    orientation = Quaternion(x=0.0, y=0.0, z=math.sin(yaw_rad / 2.0), w=math.cos(yaw_rad / 2.0))
    return Pose(position=position, orientation=orientation)


def _above(enu: Float64Array, height_m: float) -> Float64Array:
    return np.asarray(enu + np.array([0.0, 0.0, height_m]))


def _marker(
    header: Header, namespace: str, number: int, kind: int, position: Float64Array, yaw_rad: float = 0.0
) -> Marker:
    return Marker(
        header=header,
        ns=namespace,
        id=number,
        type=int(kind),
        action=Marker.ADD,
        pose=_pose(position, yaw_rad),
        lifetime=DurationMsg(sec=int(MARKER_LIFETIME_S), nanosec=0),
    )


def _color(red: float, green: float, blue: float, alpha: float) -> ColorRGBA:
    return ColorRGBA(r=float(red), g=float(green), b=float(blue), a=min(1.0, float(alpha)))
