"""Errors that this package raises on purpose: each message names the thing and what to do about it."""


class CrossLocError(Exception):
    """Base of every error that a user can cause and mend; `cli` and `ros` print it without a traceback."""


class ConfigError(CrossLocError):
    """A configuration value is unknown, of the wrong type or out of range."""


class CloudError(CrossLocError):
    """A point cloud or point-cloud message cannot be used as it is."""


class PoseError(CrossLocError):
    """A message with a pose, such as odometry or an initial pose, cannot be used as it is."""


class AerialDataError(CrossLocError):
    """An aerial file is unreadable, has no usable CRS, or disagrees with the others of the build."""


class MapError(CrossLocError):
    """A map folder is missing, damaged, of another version or made by another encoder."""


class CheckpointError(CrossLocError):
    """A weights file is unreadable, incomplete or of another model."""


class BagError(CrossLocError):
    """A bag is unreadable or lacks a topic."""


class TrainingError(CrossLocError):
    """A set of training places or a training run is missing, damaged or does not fit the other."""


class EvaluationError(CrossLocError):
    """An evaluation set or predictions are missing, damaged or do not belong together."""


class DatasetError(CrossLocError):
    """A dataset of clouds and pickles lacks files, is damaged, holds code, or cannot be made of the recordings."""
