"""What a configured localizer node is made of, and how its parts are connected.

What the inputs receive in the executor's thread reaches the session as tasks of the worker, in the order of arrival.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass

from rclpy.lifecycle import LifecycleNode

from crossloc3d_ros.config import LocalizerNodeConfig
from crossloc3d_ros.errors import ConfigError
from crossloc3d_ros.localization.fusion.priors import PosePrior
from crossloc3d_ros.localization.localizer import Localizer
from crossloc3d_ros.localization.session import Session
from crossloc3d_ros.ros.diagnostics import Statistics
from crossloc3d_ros.ros.imu_input import ImuInput
from crossloc3d_ros.ros.initial_pose_input import InitialPoseInput
from crossloc3d_ros.ros.lidar_input import Arrival, LidarInput
from crossloc3d_ros.ros.localizing import Localizing
from crossloc3d_ros.ros.odometry_input import OdometryInput
from crossloc3d_ros.ros.outputs import Outputs
from crossloc3d_ros.ros.transforms import MapTransform, TransformSource
from crossloc3d_ros.ros.worker import Worker
from crossloc3d_ros.types import Float64Array


class Transforms:
    """What the node has of TF; checked before weights and map are loaded."""

    def __init__(self, node: LifecycleNode, config: LocalizerNodeConfig) -> None:
        """Listen and announce as configured; ConfigError for what cannot be."""
        if config.mounting_from_tf and not config.base_frame_id:
            raise ConfigError("mounting_from_tf needs a base_frame_id")
        if config.tf_broadcast and config.odometry != "topic":
            raise ConfigError("tf_broadcast needs odometry from a topic: that is the frame whose pose it publishes")
        tolerance_ns = round(1e9 * config.transform_tolerance)
        self.map = MapTransform(node, config.global_frame_id, tolerance_ns) if config.tf_broadcast else None
        self.source = TransformSource(node, config.base_frame_id) if config.mounting_from_tf else None

    @property
    def pose_on_base(self) -> Callable[[str], Float64Array] | None:
        """What gives `T_base_frame` (4, 4) by the frame's name; None where TF is not used for it."""
        return None if self.source is None else self.source.pose_on_base

    def close(self) -> None:
        """Withdraw from TF."""
        for part in (self.map, self.source):
            if part is not None:
                part.close()


@dataclass(frozen=True, eq=False)
class Parts:
    """What a configured node is made of."""

    config: LocalizerNodeConfig
    localizer: Localizer
    lidar: LidarInput
    odometry: OdometryInput | None
    imu: ImuInput
    initial_pose: InitialPoseInput
    outputs: Outputs
    localizing: Localizing
    worker: Worker
    statistics: Statistics
    transforms: Transforms

    def subscribe(self, node: LifecycleNode) -> Iterator[object]:
        """Yield subscription after subscription; the clouds last, when everything beside them is there."""
        if self.odometry is not None:
            yield from self.odometry.subscribe(node)
        yield from self.imu.subscribe(node)
        yield from self.initial_pose.subscribe()
        yield from self.lidar.subscribe(node)

    def close(self) -> None:
        """Withdraw everything from ROS."""
        self.localizing.close()
        self.initial_pose.close()
        self.outputs.close()
        self.transforms.close()


def assemble(
    node: LifecycleNode,
    config: LocalizerNodeConfig,
    localizer: Localizer,
    transforms: Transforms,
    status_name: str,
    why_no_prior: Callable[[], str],
) -> Parts:
    """Bring inputs, work and outputs together; `why_no_prior` returns why no initial pose can be used at present."""
    pose_on_base, statistics = transforms.pose_on_base, Statistics()
    session = Session(localizer, config.odometry, config.imu_time_constant_s)
    frames = config.base_frame_id, config.odom_frame_id
    uses_topic = config.odometry == "topic"
    odometry = OdometryInput(*frames, config.odometry_timeout_s, pose_on_base) if uses_topic else None
    frame = localizer.aerial_map.frame
    outputs = Outputs(node, config, frame, status_name, transforms.map)
    localizing = Localizing(session, odometry, outputs, statistics, node.get_logger())
    worker = Worker("localize", config.queue_depth)

    def offer(arrival: Arrival) -> int:
        return worker.offer(lambda: localizing.process(arrival))

    def on_acceleration(stamp_ns: int, acceleration: Float64Array) -> None:
        worker.post(lambda: session.add_acceleration(stamp_ns, acceleration), is_sample=True)

    def on_heading(heading: PosePrior) -> None:
        worker.post(lambda: session.add_heading(heading), is_sample=True)

    def on_prior(prior: PosePrior) -> None:
        worker.post(lambda: session.add_prior(prior))

    return Parts(
        config=config,
        localizer=localizer,
        lidar=LidarInput(offer, statistics, pose_on_base),
        odometry=odometry,
        imu=ImuInput(config, frame, on_acceleration, on_heading, pose_on_base),
        initial_pose=InitialPoseInput(
            node,
            localizer.aerial_map,
            config.global_frame_id,
            config.base_frame_id,
            on_prior,
            why_no_prior,
            outputs.pose_of_odom,
        ),
        outputs=outputs,
        localizing=localizing,
        worker=worker,
        statistics=statistics,
        transforms=transforms,
    )
