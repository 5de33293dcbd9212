"""Play a recording into ROS with its own timing, so that a live node can be tested where `ros2 bag` is not at hand.

Messages go out as the bytes that were recorded. Each is due at an absolute moment, so that delays do not add up.
"""

from __future__ import annotations

import importlib
import itertools
import logging
import re
import time
from collections import deque
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass

import numpy as np
import rclpy
from builtin_interfaces.msg import Time as TimeMsg
from rclpy.duration import Duration
from rclpy.node import Node
from rclpy.publisher import Publisher
from rclpy.qos import DurabilityPolicy, HistoryPolicy, QoSProfile, ReliabilityPolicy
from rclpy.signals import SignalHandlerOptions
from rosgraph_msgs.msg import Clock

from crossloc3d_ros.config import PlayerConfig
from crossloc3d_ros.errors import BagError, CrossLocError
from crossloc3d_ros.formats.bag import POINT_CLOUD, BagReader, BagTopic, RawMessage
from crossloc3d_ros.ros.shared_memory import prepare_for_large_clouds

log = logging.getLogger(__name__)

_MESSAGE_TYPE = re.compile(r"([a-z]\w*)/msg/([A-Z]\w*)")
_LATE_MS = 100.0
_ACKNOWLEDGED_WITHIN_S = 2.0
_SETTLE_S = 0.5


@dataclass(frozen=True)
class PlayReport:
    """How well the timing was kept."""

    messages: int
    duration_s: float
    late_median_ms: float
    late_p99_ms: float


OnPublished = Callable[[RawMessage, int], None]
"""Called after each message with the message and `time.monotonic_ns()` of just before its publication."""


class Player:
    """Publishers for a recording's topics, in a node of the given context."""

    def __init__(self, bag: BagReader, node: Node, config: PlayerConfig, topics: Sequence[str] | None = None) -> None:
        """Make a publisher for every topic of the bag, or for `topics`, with the QoS that was recorded.

        Topics whose message type is not installed here are left out with a warning; BagError if nothing remains.
        """
        self._bag = bag
        self._node = node
        self._config = config
        known = bag.topics()
        for name in topics or ():
            bag.topic(name, known[name].msgtype if name in known else "")
        self._publishers: dict[str, Publisher] = {}
        self._clouds: list[Publisher] = []
        self._count = 0
        for topic in known.values():
            if topics is not None and topic.name not in topics:
                continue
            if config.clock and topic.name == "/clock":
                continue  # two clocks would fight
            message_class = _message_class(topic.msgtype)
            if message_class is None:
                log.warning("'%s' is not played: %s is not installed", topic.name, topic.msgtype)
                continue
            publisher = node.create_publisher(message_class, topic.name, qos_of(topic))
            self._publishers[topic.name] = publisher
            if topic.msgtype == POINT_CLOUD:
                self._clouds.append(publisher)
        if not self._publishers:
            raise BagError(f"{bag.path} holds nothing that could be played")
        clock_qos = QoSProfile(depth=1, history=HistoryPolicy.KEEP_LAST, reliability=ReliabilityPolicy.BEST_EFFORT)
        self._clock = node.create_publisher(Clock, "/clock", clock_qos) if config.clock else None

    def wait_for_subscribers(self, check: Callable[[], None] = lambda: None) -> None:
        """Return once every topic with clouds (any topic, if there are none) is subscribed to.

        Raises CrossLocError after `wait_s`; `check` is called now and then and may raise earlier. Meanwhile `/clock`
        stands at the start of the recording, because a node with simulated time may need it to come up.
        """
        if self._config.wait_s == 0.0:
            return
        deadline = time.monotonic() + self._config.wait_s
        while not self._subscribed():
            check()
            if time.monotonic() > deadline:
                waiting = ", ".join(p.topic_name for p in self._clouds) or "any of the topics"
                raise CrossLocError(
                    f"no node subscribed to {waiting} within {self._config.wait_s:g} s; start the localizer with "
                    "'--ros-args -r points:=TOPIC', check that ROS_DOMAIN_ID is the same, or give --wait-s 0"
                )
            self._tick(self._bag.start_ns)
            time.sleep(0.02)
        # Discovery has two ends: that we have discovered the subscriber does not mean that it has discovered us, and
        # best effort loses what comes before.
        settled = time.monotonic() + _SETTLE_S
        while time.monotonic() < settled:
            self._tick(self._bag.start_ns)
            time.sleep(0.02)

    def play(self, on_published: OnPublished | None = None) -> PlayReport:
        """Publish everything once, or until interrupted with `loop`; BagError where the recording breaks off."""
        late_ms: deque[float] = deque(maxlen=1_000_000)  # a loop may go on for days
        self._count = 0
        started = time.monotonic()
        for _ in itertools.count() if self._config.loop else range(1):
            self._play_once(late_ms, on_published)
        for publisher in self._publishers.values():
            publisher.wait_for_all_acked(Duration(seconds=_ACKNOWLEDGED_WITHIN_S))
        late = np.array(late_ms) if late_ms else np.zeros(1)
        return PlayReport(
            messages=self._count,
            duration_s=time.monotonic() - started,
            late_median_ms=float(np.median(late)),
            late_p99_ms=float(np.percentile(late, 99)),
        )

    def _play_once(self, late_ms: deque[float], on_published: OnPublished | None) -> None:
        first_ns = self._bag.start_ns
        begin_ns = time.monotonic_ns() + 50_000_000  # time to read the first message
        period_ns = round(1e9 / self._config.clock_hz)
        next_tick_ns = begin_ns
        warned = False
        for message in self._bag.raw_messages(list(self._publishers)):
            due_ns = begin_ns + round((message.t_ns - first_ns) / self._config.rate)
            while self._clock is not None and next_tick_ns <= due_ns:
                _sleep_until(next_tick_ns)
                self._tick(first_ns + round((next_tick_ns - begin_ns) * self._config.rate))
                # After a stall one tick with the present time is better than a burst of old ones.
                next_tick_ns = max(next_tick_ns + period_ns, time.monotonic_ns() - period_ns)
            _sleep_until(due_ns)
            published_ns = time.monotonic_ns()
            self._publishers[message.topic].publish(message.cdr)
            self._count += 1
            late_ms.append((published_ns - due_ns) / 1e6)
            if late_ms[-1] > _LATE_MS and not warned:
                log.warning("this machine cannot keep the pace: a message is %.0f ms late", late_ms[-1])
                warned = True
            if on_published is not None:
                on_published(message, published_ns)

    def _tick(self, t_ns: int) -> None:
        if self._clock is not None:
            seconds, nanoseconds = divmod(t_ns, 1_000_000_000)
            self._clock.publish(Clock(clock=TimeMsg(sec=int(seconds), nanosec=int(nanoseconds))))

    def _subscribed(self) -> bool:
        if self._clouds:
            return all(publisher.get_subscription_count() > 0 for publisher in self._clouds)
        return any(publisher.get_subscription_count() > 0 for publisher in self._publishers.values())


def play_bag(
    bag: BagReader,
    config: PlayerConfig,
    *,
    topics: Sequence[str] | None = None,
    ros_arguments: Sequence[str] = (),
    on_ready: Callable[[], None] | None = None,
    on_published: OnPublished | None = None,
) -> PlayReport:
    """Play an open bag from a ROS context of its own.

    `ros_arguments` are what follows `--ros-args` (remappings). `on_ready` is called when subscribers are there.
    KeyboardInterrupt passes through, after the context is shut down.
    """
    prepare_for_large_clouds()
    context = rclpy.Context()
    arguments = ["--ros-args", *ros_arguments] if ros_arguments else []
    rclpy.init(args=arguments, context=context, signal_handler_options=SignalHandlerOptions.NO)
    try:
        node = Node("crossloc3d_player", context=context, start_parameter_services=False, enable_rosout=False)
        try:
            player = Player(bag, node, config, topics)
            player.wait_for_subscribers()
            if on_ready is not None:
                on_ready()
            return player.play(on_published)
        finally:
            node.destroy_node()
    finally:
        with suppress(RuntimeError):
            rclpy.shutdown(context=context)


def qos_of(topic: BagTopic) -> QoSProfile:
    """Return the QoS to offer for a topic: the recorded one; where publishers differed or nothing is known, reliable.

    A reliable publisher serves every subscriber, as `ros2 bag play` has it.
    """
    offers = set(topic.offered_qos_profiles)
    same = {(offer.reliability, offer.durability) for offer in offers}
    reliability, durability = next(iter(same)) if len(same) == 1 else ("reliable", "volatile")
    depth = max([offer.depth for offer in offers], default=10)
    return QoSProfile(
        history=HistoryPolicy.KEEP_LAST,
        depth=max(depth, 10),
        reliability=ReliabilityPolicy.BEST_EFFORT if reliability == "best_effort" else ReliabilityPolicy.RELIABLE,
        durability=(DurabilityPolicy.TRANSIENT_LOCAL if durability == "transient_local" else DurabilityPolicy.VOLATILE),
    )


def _message_class(msgtype: str) -> type | None:
    match = _MESSAGE_TYPE.fullmatch(msgtype)
    if match is None:
        return None
    try:
        return getattr(importlib.import_module(f"{match[1]}.msg"), match[2], None)
    except ImportError:
        return None


def _sleep_until(monotonic_ns: int) -> None:
    remaining_ns = monotonic_ns - time.monotonic_ns()
    if remaining_ns > 0:
        time.sleep(remaining_ns / 1e9)
