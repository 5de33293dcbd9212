"""Locate a robot in an airborne LiDAR survey from one LiDAR, without GNSS or a first guess."""

from pathlib import Path

from crossloc3d_ros.compiled_cache import ensure_cache

__version__ = "0.1.0"

ensure_cache(Path(__file__).parent)
