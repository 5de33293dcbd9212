"""The encoder as its users see it: points in, descriptors out."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence

import numpy as np
import torch

from crossloc3d_ros.config import (
    CalibrationConfig,
    ModelConfig,
    PreprocessingConfig,
    from_dict,
    to_dict,
    usable_threads,
)
from crossloc3d_ros.encoder.base import Network
from crossloc3d_ros.encoder.compiled import CompiledModel
from crossloc3d_ros.encoder.model import CrossLoc3D
from crossloc3d_ros.errors import CheckpointError, CloudError, ConfigError
from crossloc3d_ros.types import Float32Array

MAX_HEADINGS = 64  # the largest that training allows (`TrainConfig.headings`, `rotations`)


class Encoder:
    """Trained weights, ready to encode; one object serves any number of threads."""

    def __init__(
        self,
        model: Network,
        preprocessing: PreprocessingConfig,
        fingerprint: str,
        *,
        metadata: Mapping[str, str] | None = None,
        device: str = "cpu",
        threads: int | None = None,
    ) -> None:
        self._model = model.eval().to(device)
        self._device = device
        self._compiled = None
        if device == "cpu" and isinstance(model, CrossLoc3D) and CompiledModel.can_compile(model):
            self._compiled = CompiledModel(model, usable_threads() if threads is None else threads)
        self._preprocessing = preprocessing
        self._fingerprint = fingerprint
        self.metadata = dict(metadata or {})
        self._calibration = _calibration(self.metadata)
        self._headings = _count(self.metadata, "headings")
        self._rotations = _count(self.metadata, "turns")

    @property
    def fingerprint(self) -> str:
        """Identify weights, model and preprocessing: a map is used only with the encoder that made it."""
        return self._fingerprint

    @property
    def preprocessing(self) -> PreprocessingConfig:
        """Return the preprocessing that the weights were trained on."""
        return self._preprocessing

    @property
    def model_config(self) -> ModelConfig:
        """Return the configuration of the network."""
        return self._model.config

    @property
    def calibration(self) -> CalibrationConfig | None:
        """Return what distances between the descriptors mean, as fitted after training; None without a calibration."""
        return self._calibration

    @property
    def headings(self) -> int:
        """Return in how many headings a query must be tried against north-up submaps; 1 = the heading is free.

        Stored with the weights, because they were trained for it.
        """
        return self._headings

    @property
    def rotations(self) -> int:
        """Return over how many test-time rotations a query's descriptor is averaged, where the heading is free.

        Learned invariance to the heading is not exact: the mean over some rotations is closer to it. Stored
        with the weights, because the calibration is that of the averaged descriptors.
        """
        return self._rotations

    @property
    def descriptor_size(self) -> int:
        """Numbers in a descriptor."""
        return self._model.config.descriptor_size

    def encode(self, points: Float32Array) -> Float32Array:
        """Return the descriptor (D,) of a patch's points (n, 3) in [-1, 1]."""
        row: Float32Array = self.encode_batch([points])[0]
        return row

    def encode_batch(self, clouds: Sequence[Float32Array]) -> Float32Array:
        """Return the descriptors (B, D) of B patches; each depends on its own points alone."""
        for cloud in clouds:
            if cloud.ndim != 2 or cloud.shape[1] != 3 or len(cloud) == 0:
                raise CloudError(f"a patch must be an array (n, 3) with n > 0, got {cloud.shape}")
        arrays = [np.ascontiguousarray(cloud, np.float32) for cloud in clouds]
        if self._compiled is not None:
            return self._compiled.encode_many(arrays)
        with torch.no_grad():
            tensors = [torch.from_numpy(array).to(self._device) for array in arrays]
            result: Float32Array = self._model(tensors).cpu().numpy()
        return result

    def warm_up(self) -> None:
        """Compile and touch whatever makes the first call slow."""
        spread = np.random.default_rng(0).uniform(-1.0, 1.0, (self._preprocessing.n_points, 3))
        self.encode(spread.astype(np.float32))


_STORED_CALIBRATION = {"none_distance": "null_distance", "none_scale": "null_scale"}
"""The names that the weights' format, crossloc3d_ros/1, gives to settings."""


def stored_calibration(calibration: CalibrationConfig) -> str:
    """Return a calibration as the weights' metadata hold it, under `credibility`."""
    names = {name: stored for stored, name in _STORED_CALIBRATION.items()}
    return json.dumps({names.get(name, name): value for name, value in to_dict(calibration).items()})


def _calibration(metadata: Mapping[str, str]) -> CalibrationConfig | None:
    if "credibility" not in metadata:
        return None
    try:
        stored = json.loads(metadata["credibility"])
        return from_dict(CalibrationConfig, {_STORED_CALIBRATION.get(key, key): stored[key] for key in stored})
    except (json.JSONDecodeError, AttributeError, ConfigError) as error:
        raise CheckpointError(f"the calibration in the weights cannot be used ({error}); export them again") from error


def _count(metadata: Mapping[str, str], key: str) -> int:
    text = metadata.get(key, "1")
    if not text.isdecimal() or not 1 <= int(text) <= MAX_HEADINGS:
        raise CheckpointError(f"the weights name {text!r} {key}, not 1 to {MAX_HEADINGS}; export them again")
    return int(text)
