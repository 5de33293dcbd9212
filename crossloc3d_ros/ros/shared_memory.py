"""Enough shared memory for point clouds: a profile for Fast DDS, which by default loses most clouds of 480 KB and more.

A VLP-16 revolution of 30,000 points is 660 KB, and Fast DDS's shared-memory segment is 512 KB. It is the publishing
process that needs the profile, before `rclpy.init`; on the subscriber's side alone it does not help.
"""

from __future__ import annotations

import logging
import os
import tempfile
from collections.abc import MutableMapping
from pathlib import Path

from crossloc3d_ros.files import write_atomically

PROFILES_VARIABLE = "FASTRTPS_DEFAULT_PROFILES_FILE"
_USERS_OWN = (PROFILES_VARIABLE, "FASTDDS_DEFAULT_PROFILES_FILE")
SEGMENT_BYTES = 32 * 1024 * 1024

PROFILE = f"""<?xml version="1.0" encoding="UTF-8" ?>
<dds xmlns="http://www.eprosima.com/XMLSchemas/fastRTPS_Profiles">
  <profiles>
    <transport_descriptors>
      <transport_descriptor>
        <transport_id>clouds_shared_memory</transport_id>
        <type>SHM</type>
        <segment_size>{SEGMENT_BYTES}</segment_size>
      </transport_descriptor>
      <transport_descriptor>
        <transport_id>clouds_udp</transport_id>
        <type>UDPv4</type>
      </transport_descriptor>
    </transport_descriptors>
    <participant profile_name="clouds" is_default_profile="true">
      <rtps>
        <userTransports>
          <transport_id>clouds_shared_memory</transport_id>
          <transport_id>clouds_udp</transport_id>
        </userTransports>
        <useBuiltinTransports>false</useBuiltinTransports>
      </rtps>
    </participant>
  </profiles>
</dds>
"""

logger = logging.getLogger(__name__)


def prepare_for_large_clouds(environment: MutableMapping[str, str] | None = None) -> Path | None:
    """Make Fast DDS, in this process or one started with `environment`, transport clouds without loss.

    Call it before `rclpy.init` in whatever publishes clouds. Returns the profile's path; None where the user has set
    a profile, which is left alone, or uses another middleware, which needs none.
    """
    variables = os.environ if environment is None else environment
    if variables.get("RMW_IMPLEMENTATION", "rmw_fastrtps_cpp") not in ("rmw_fastrtps_cpp", "rmw_fastrtps_dynamic_cpp"):
        return None
    for name in _USERS_OWN:
        if variables.get(name):
            logger.debug("keeping the Fast DDS profile that %s names", name)
            return None
    path = write_profile(_profile_folder(variables) / "fastdds_clouds.xml")
    variables[PROFILES_VARIABLE] = str(path)
    return path


def write_profile(path: Path) -> Path:
    """Write the profile to `path`, whole or not at all, and return the path."""
    if path.is_file() and path.read_text(encoding="utf-8") == PROFILE:
        return path
    write_atomically(path, PROFILE, parents=True)  # processes that start together may write together
    return path


def _profile_folder(variables: MutableMapping[str, str]) -> Path:
    """Return a folder of this user's that can be written: the cache, or a temporary one on a robot without home."""
    home = variables.get("XDG_CACHE_HOME") or str(Path(variables.get("HOME") or "/nonexistent") / ".cache")
    for folder in (Path(home) / "crossloc3d_ros", Path(tempfile.gettempdir()) / f"crossloc3d_ros_{os.getuid()}"):
        try:
            folder.mkdir(mode=0o700, parents=True, exist_ok=True)
            # A folder of somebody else's under a name that can be guessed is not to be trusted.
            if folder.stat().st_uid == os.getuid() and os.access(folder, os.W_OK):
                return folder
        except OSError:
            continue
    return Path(tempfile.mkdtemp(prefix="crossloc3d_ros_"))
