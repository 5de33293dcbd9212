"""Subscriptions whose QoS the user may override."""

from __future__ import annotations

import copy
from collections.abc import Callable
from typing import Any

from rclpy.event_handler import SubscriptionEventCallbacks
from rclpy.node import Node
from rclpy.qos import QoSProfile
from rclpy.qos_overriding_options import InvalidQosOverridesError, QoSOverridingOptions
from rclpy.subscription import Subscription

from crossloc3d_ros.errors import ConfigError

REPEAT_REASON_S = 10.0
"""The same complaint is logged no more often."""


def subscribe(
    node: Node,
    kind: type,
    topic: str,
    callback: Callable[[Any], None],
    profile: QoSProfile,
    events: SubscriptionEventCallbacks | None = None,
) -> Subscription:
    """Subscribe with `profile`, or as the user has overridden it; ConfigError for overrides that cannot be."""
    try:
        return node.create_subscription(
            kind,
            topic,
            callback,
            copy.copy(profile),  # rclpy writes the overrides into the profile that it is given
            qos_overriding_options=QoSOverridingOptions.with_default_policies(),
            event_callbacks=events,
        )
    except (InvalidQosOverridesError, RuntimeError, TypeError, ValueError) as error:
        raise ConfigError(f"qos_overrides.{node.resolve_topic_name(topic)}.subscription: {error}") from error
