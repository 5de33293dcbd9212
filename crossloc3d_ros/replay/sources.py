"""Which topics of a recording are replayed: the clouds, and what measures the motion between them."""

from __future__ import annotations

from crossloc3d_ros.config import LocalizerNodeConfig
from crossloc3d_ros.errors import BagError, ConfigError
from crossloc3d_ros.formats.bag import ODOMETRY, POINT_CLOUD, BagReader
from crossloc3d_ros.replay.recorded import OdometrySource


def choose_cloud_topic(bag: BagReader, chosen: str | None) -> str:
    """Return the topic with the clouds: the chosen one, or the only one there is; BagError lists the topics."""
    if chosen is not None:
        return bag.topic(chosen, POINT_CLOUD).name
    return bag.only_topic(POINT_CLOUD, "choose one with --topic").name


def choose_odometry(
    bag: BagReader, chosen: str | None, config: LocalizerNodeConfig, *, asked_for: bool = False
) -> OdometrySource | None:
    """Return what measures how the robot moves, as `config.odometry` wants it; None where nothing does.

    `chosen` is a topic. Without one, the only topic that is not called ground truth, or `/odom` among several. A
    recording without any is localized without odometry, unless a topic was `asked_for`: then BagError lists what there
    is, as it does where several topics leave the choice open.
    """
    if chosen is not None and asked_for and config.odometry != "topic":
        raise ConfigError(f"--odom-topic has no meaning with --odometry {config.odometry}")
    if chosen is None and config.odometry == "none":
        return None
    if chosen is None and config.odometry == "scan":
        return OdometrySource(None, config.base_frame_id)
    if chosen is not None:
        return OdometrySource(bag.topic(chosen, ODOMETRY).name, config.base_frame_id)
    names = [t.name for t in bag.topics().values() if t.msgtype == ODOMETRY and "truth" not in t.name]
    if not names:
        if asked_for:
            bag.only_topic(ODOMETRY, "choose one with --odom-topic")
            raise BagError(f"{bag.path} has no odometry beside ground truth; --odom-topic takes that too")
        return None
    if len(names) > 1 and "/odom" not in names:
        raise BagError(f"{bag.path} has several odometry topics ({', '.join(names)}); choose one with --odom-topic")
    return OdometrySource("/odom" if len(names) > 1 else names[0], config.base_frame_id)


def odometry_words(odometry: OdometrySource | None) -> str:
    """Return for people what measures how the robot moves."""
    if odometry is None:
        return "none (--odometry scan makes one from the scans)"
    return odometry.topic or "from scan to scan, KISS-ICP"
