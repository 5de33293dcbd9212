"""Every setting in one place: frozen dataclasses from which ROS parameters, YAML files and command lines are made.

The simulator's own settings (`DriveConfig`, `TrafficConfig`, `SurveyConfig`, `LidarConfig`) stay in `simulation`: a
simulated benchmark on disk is known by a digest of the sources that made it, among them those of the sensors and of
the traffic, so that moving these classes would make every benchmark anew. `DriveConfig` is composed of them.
"""

from crossloc3d_ros.config.aerial_map import BuildConfig
from crossloc3d_ros.config.localizability import LocalizabilityConfig
from crossloc3d_ros.config.localizer import (
    AlignmentConfig,
    FusionConfig,
    LocalizerConfig,
    LocalizerNodeConfig,
    MountingConfig,
    RetrievalConfig,
    ScanConfig,
    usable_threads,
)
from crossloc3d_ros.config.network import CalibrationConfig, ModelConfig, PreprocessingConfig
from crossloc3d_ros.config.replay import PlayerConfig
from crossloc3d_ros.config.settings import (
    RENAMED,
    Setting,
    check_value,
    from_dict,
    option,
    settings_of,
    to_dict,
    unknown_setting,
)
from crossloc3d_ros.config.training import DatasetConfig, PlacesConfig, TrainConfig
from crossloc3d_ros.config.verification import HeightMapConfig, VerificationConfig

__all__ = [
    "RENAMED",
    "AlignmentConfig",
    "BuildConfig",
    "CalibrationConfig",
    "DatasetConfig",
    "FusionConfig",
    "HeightMapConfig",
    "LocalizabilityConfig",
    "LocalizerConfig",
    "LocalizerNodeConfig",
    "ModelConfig",
    "MountingConfig",
    "PlacesConfig",
    "PlayerConfig",
    "PreprocessingConfig",
    "RetrievalConfig",
    "ScanConfig",
    "Setting",
    "TrainConfig",
    "VerificationConfig",
    "check_value",
    "from_dict",
    "option",
    "settings_of",
    "to_dict",
    "unknown_setting",
    "usable_threads",
]
