"""Settings as fields of frozen dataclasses: how one is declared, read, checked and listed.

A field carries its one default, and in its metadata the sentence that describes it and the range that it may lie in.
"""

from __future__ import annotations

import dataclasses
import difflib
import functools
import types
import typing
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass, field
from typing import Any, Literal, TypeVar

from crossloc3d_ros.errors import ConfigError

T = TypeVar("T")

RENAMED = {
    "most_waiting": "queue_depth",
    "publish_tf": "tf_broadcast",
    "tf_tolerance_s": "transform_tolerance",
    "odometry_wait_s": "odometry_timeout_s",
    "scan.turn_s": "scan.period_s",
    "credibility": "retrieval",
    "credibility.temperature": "retrieval.temperature",
    "credibility.none_distance": "retrieval.null_distance",
    "credibility.none_scale": "retrieval.null_scale",
    "credibility.cluster_radius_m": "retrieval.cluster_radius_m",
    "credibility.min_probability": "retrieval.min_probability",
    "credibility.position_floor_m": "retrieval.min_std_m",
    "credibility.height_floor_m": "retrieval.min_height_std_m",
    "alignment.search": "alignment.scope",
    "alignment.exhaustive_km2": "alignment.map_max_km2",
    "alignment.exhaustive_every_s": "alignment.map_period_s",
    "alignment.convincing": "alignment.sufficient_probability",
    "alignment.search_every_s": "alignment.candidates_period_s",
    "alignment.look_every_s": "alignment.candidates_period_localized_s",
    "alignment.radius_m": "alignment.candidate_radius_m",
    "alignment.follow_m": "alignment.hypothesis_radius_m",
    "alignment.peaks": "alignment.coarse_maxima",
    "alignment.poses": "alignment.fine_maxima",
    "alignment.shape_temperature": "alignment.covariance_temperature",
    "fusion.evidence_m": "fusion.novelty_m",
    "fusion.evidence_weight": "fusion.likelihood_weight",
    "fusion.evidence_limit": "fusion.max_log_likelihood",
    "fusion.blind_share": "fusion.clutter_probability",
    "fusion.found_share": "fusion.detection_probability",
    "fusion.carried_per_s": "fusion.kidnapping_per_s",
    "fusion.prior_belief": "fusion.initial_pose_probability",
    "fusion.error_scale": "fusion.measurement_std_scale",
    "fusion.error_share": "fusion.measurement_error_correlation",
    "fusion.error_m": "fusion.measurement_correlation_m",
    "fusion.position_floor_m": "fusion.measurement_min_std_m",
    "fusion.heading_floor_deg": "fusion.measurement_min_std_deg",
    "fusion.map_error_m": "fusion.map_std_m",
    "fusion.map_turn_deg": "fusion.map_std_deg",
    "fusion.odometry_error": "fusion.odometry_relative_std",
    "fusion.odometry_turn_deg_per_m": "fusion.odometry_drift_deg_per_m",
    "fusion.odometry_gap_s": "fusion.odometry_max_gap_s",
    "fusion.slip_m": "fusion.slip_std_m",
    "fusion.slip_share": "fusion.slip_probability",
    "fusion.forget_s": "fusion.unknown_motion_decay_s",
    "turns": "rotations",
}
"""Settings of version 0.1 under other names: an old name is refused with the new one."""


_hints: Callable[[Any], dict[str, Any]] = functools.cache(typing.get_type_hints)


def option(default: T, text: str, *, low: float | None = None, high: float | None = None) -> T:
    """Declare a dataclass field with a description and, for numbers, an inclusive range."""
    return field(default=default, metadata={"text": text, "low": low, "high": high})


def to_dict(config: Any) -> dict[str, Any]:
    """Return the configuration as plain nested dicts, ready for JSON or YAML."""
    return dataclasses.asdict(config)


def from_dict(kind: type[T], values: Mapping[str, Any], *, where: str = "") -> T:
    """Build a configuration from nested mappings; unknown keys, wrong types and out-of-range values raise ConfigError.

    Missing keys keep their defaults. `where` prefixes the names in messages.
    """
    hints = _hints(kind)
    fields = {f.name: f for f in dataclasses.fields(kind)}  # type: ignore[arg-type]
    arguments: dict[str, Any] = {}
    for key, value in values.items():
        name = f"{where}{key}"
        if key not in fields:
            raise ConfigError(unknown_setting(name, sorted(fields)))
        arguments[key] = check_value(name, hints[key], value, fields[key].metadata)
    return kind(**arguments)


def unknown_setting(name: str, known: Iterable[str], noun: str = "setting") -> str:
    """Return the message for a name that no field has: what it is called now, what it may have meant, or what exists.

    `known` are the names that `name` may have been, without the groups that precede them in `name`.
    """
    if name in RENAMED:
        return f"{noun} '{name}' is now called '{RENAMED[name]}'"
    names = list(known)
    close = difflib.get_close_matches(name, names, n=1) or difflib.get_close_matches(
        name.rpartition(".")[2], names, n=1
    )
    hint = f"did you mean '{close[0]}'?" if close else f"known are: {', '.join(names)}"
    return f"unknown {noun} '{name}': {hint}"


def check_value(name: str, hint: Any, value: Any, metadata: Mapping[str, Any]) -> Any:
    """Return `value` converted to the field's type, or raise ConfigError naming the setting."""
    if typing.get_origin(hint) in (typing.Union, types.UnionType):
        if value is None and type(None) in typing.get_args(hint):
            return None
        hint = next(a for a in typing.get_args(hint) if a is not type(None))
    if dataclasses.is_dataclass(hint):
        if not isinstance(value, Mapping):
            raise ConfigError(f"'{name}' must be a group of settings, got {value!r}")
        return from_dict(typing.cast(type[Any], hint), value, where=f"{name}.")
    origin = typing.get_origin(hint)
    if origin is Literal:
        if value not in typing.get_args(hint):
            raise ConfigError(f"'{name}' must be one of {', '.join(map(str, typing.get_args(hint)))}, got {value!r}")
        return value
    if origin is tuple:
        inner = typing.get_args(hint)
        if not isinstance(value, (list, tuple)):
            raise ConfigError(f"'{name}' must be a list, got {value!r}")
        if inner[-1] is not Ellipsis and len(value) != len(inner):
            raise ConfigError(f"'{name}' must hold {len(inner)} values, got {len(value)}")
        return tuple(check_value(f"{name}[{i}]", inner[0], v, metadata) for i, v in enumerate(value))
    if hint is float and isinstance(value, int) and not isinstance(value, bool):
        value = float(value)
    if not isinstance(value, hint) or (hint is not bool and isinstance(value, bool)):
        raise ConfigError(f"'{name}' must be of type {hint.__name__}, got {value!r}")
    if isinstance(value, (int, float)) and not isinstance(value, bool):
        low, high = metadata.get("low"), metadata.get("high")
        if not ((low is None or value >= low) and (high is None or value <= high)):
            raise ConfigError(f"'{name}' must lie between {low} and {high}, got {value}")
    return value


@dataclass(frozen=True)
class Setting:
    """One plain field of a configuration, however deep."""

    name: str
    """Dotted path, such as `scan.mounting.z_m`."""
    hint: Any
    default: Any
    metadata: Mapping[str, Any]

    @property
    def text(self) -> str:
        """The sentence that describes it."""
        return str(self.metadata.get("text", ""))

    @property
    def low(self) -> float | None:
        """Least value of a number, or of each number of a list."""
        return self.metadata.get("low")

    @property
    def high(self) -> float | None:
        """Largest value of a number, or of each number of a list."""
        return self.metadata.get("high")

    @property
    def choices(self) -> tuple[str, ...]:
        """The texts to choose from, where they are limited."""
        return typing.get_args(self.hint) if typing.get_origin(self.hint) is Literal else ()


def settings_of(kind: type[Any], prefix: str = "") -> Iterator[Setting]:
    """Yield the plain fields of a configuration dataclass and of the groups that it holds."""
    hints = _hints(kind)
    for item in dataclasses.fields(kind):
        hint = hints[item.name]
        if dataclasses.is_dataclass(hint):
            yield from settings_of(typing.cast(type[Any], hint), f"{prefix}{item.name}.")
        else:
            yield Setting(f"{prefix}{item.name}", hint, item.default, item.metadata)
