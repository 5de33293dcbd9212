"""Locate a robot in an airborne LiDAR survey from one LiDAR, without GNSS or a first guess."""

__version__ = "0.1.0"
