"""Weights on disk: one safetensors file that holds the configuration of the model and of the preprocessing.

Large tensors may be stored as float16; batch-norm statistics and everything small stay float32.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any, Literal, NamedTuple, TypeVar

import torch
from safetensors import SafetensorError, safe_open
from safetensors.torch import save_file
from torch import Tensor

from crossloc3d_ros.config import ModelConfig, PreprocessingConfig, from_dict, to_dict
from crossloc3d_ros.encoder.base import Network
from crossloc3d_ros.encoder.networks import make_network
from crossloc3d_ros.encoder.runtime import Encoder
from crossloc3d_ros.errors import CheckpointError, ConfigError
from crossloc3d_ros.files import atomic_path

T = TypeVar("T")

FORMAT = "crossloc3d_ros/1"
WEIGHTS_FOLDER = Path(__file__).resolve().parents[1] / "weights"
SHIPPED_WEIGHTS = WEIGHTS_FOLDER / "crossloc3d.safetensors"
_SMALL = 4096
"""Tensors of at most this many numbers are never stored as float16."""
_ALWAYS_COUNTED = {
    "voxel_sizes", "kept_branches", "refinement", "sub_steps", "memory_sizes", "time_embedding", "channels", "heads",
    "fused_channels", "clusters", "descriptor_size", "half_extent_m", "scan_half_extent_m", "n_points",
    "ground_clearance_m", "thin_m", "min_points", "scan_origin", "submap_origin", "vertical_origin", "seed",
}  # fmt: skip
"""The settings of the first weights. One that came later counts in a fingerprint only where it is not at its default,
so that a new setting leaves maps and weights that know nothing of it as they are."""


class Checkpoint(NamedTuple):
    """What a weights file holds."""

    model: Network
    preprocessing: PreprocessingConfig
    metadata: dict[str, str]
    """What the writer noted besides: training, data, calibration."""
    fingerprint: str


def save_checkpoint(
    path: Path,
    model: Network,
    preprocessing: PreprocessingConfig,
    metadata: Mapping[str, str] | None = None,
    dtype: Literal["float16", "float32"] = "float16",
) -> None:
    """Write the model atomically; a weight beyond the range of float16, or a full disk, raises CheckpointError."""
    state: dict[str, Tensor] = {}
    for key, tensor in model.state_dict().items():
        value = tensor.detach().cpu().contiguous()
        if dtype == "float16" and value.is_floating_point() and value.numel() > _SMALL:
            value = value.to(torch.float16)
        if not torch.isfinite(value).all():
            raise CheckpointError(
                f"'{key}' holds numbers that are not finite in {dtype}; nothing was written to {path}"
            )
        state[key] = value
    header = {
        **(metadata or {}),
        "format": FORMAT,
        "model": json.dumps(to_dict(model.config), sort_keys=True),
        "preprocessing": json.dumps(to_dict(preprocessing), sort_keys=True),
    }
    try:
        with atomic_path(path, None, parents=True) as partial:
            save_file(state, partial, metadata=header)
            partial.chmod(0o644)  # safetensors keeps them from everybody else, also from the robot's user
    except (OSError, SafetensorError) as error:
        raise CheckpointError(f"cannot write {path}: {error}; nothing was written") from error


def load_checkpoint(path: Path) -> Checkpoint:
    """Read a weights file; anything missing, unknown or of another shape raises CheckpointError."""
    try:
        with safe_open(path, framework="pt") as file:
            header = dict(file.metadata() or {})
            if header.get("format") != FORMAT:
                raise CheckpointError(
                    f"{path} is not in the format {FORMAT} but in {header.get('format')!r}; "
                    "for the authors' file use import_checkpoint"
                )
            state = {key: file.get_tensor(key) for key in file.keys()}  # noqa: SIM118 - not a dict
    except FileNotFoundError as error:
        raise CheckpointError(f"no such weights file: {path}") from error
    except (SafetensorError, OSError) as error:
        raise CheckpointError(f"{path} cannot be read as safetensors ({error}); is it complete?") from error
    try:
        config = from_dict(ModelConfig, json.loads(header["model"]))
        preprocessing = from_dict(PreprocessingConfig, json.loads(header["preprocessing"]))
        model = make_network(config)
    except (KeyError, json.JSONDecodeError, ConfigError) as error:
        raise CheckpointError(f"{path} holds no usable configuration: {error}") from error
    expected = model.state_dict()
    missing, unknown = sorted(set(expected) - set(state)), sorted(set(state) - set(expected))
    if missing or unknown:
        raise CheckpointError(
            f"{path} does not fit its own configuration of a network '{config.network}': "
            f"missing {missing[:3]}, unknown {unknown[:3]}"
        )
    for key, tensor in state.items():
        if tensor.shape != expected[key].shape:
            raise CheckpointError(
                f"{path}: '{key}' has shape {tuple(tensor.shape)}, the model needs {tuple(expected[key].shape)}"
            )
    model.load_state_dict({key: tensor.to(expected[key].dtype) for key, tensor in state.items()})
    notes = {key: value for key, value in header.items() if key not in ("format", "model", "preprocessing")}
    return Checkpoint(model.eval(), preprocessing, notes, fingerprint(model, preprocessing))


def fingerprint(model: Network, preprocessing: PreprocessingConfig) -> str:
    """Return 16 hexadecimal digits that change with any weight, any model setting and any preprocessing setting."""
    digest = hashlib.sha256()
    settings = [_counted(model.config, ModelConfig()), _counted(preprocessing, PreprocessingConfig())]
    digest.update(json.dumps(settings, sort_keys=True).encode())
    for key, tensor in sorted(model.state_dict().items()):
        digest.update(key.encode())
        digest.update(tensor.detach().cpu().contiguous().numpy().tobytes())
    return digest.hexdigest()[:16]


def _counted(config: T, default: T) -> dict[str, Any]:
    """Return the settings that distinguish one encoder from another."""
    usual = to_dict(default)
    return {key: value for key, value in to_dict(config).items() if key in _ALWAYS_COUNTED or value != usual[key]}


def load_encoder(path: Path | None = None, device: str = "cpu", threads: int | None = None) -> Encoder:
    """Load an encoder that is ready to use.

    `path`: a weights file, by default the shipped one. `device`: "cpu" or a torch device such as "cuda".
    `threads`: CPU threads for one descriptor; by default as many as there are cores, at most four. Raises
    CheckpointError for weights and ConfigError for a device that cannot be used.
    """
    if device.split(":")[0] not in ("cpu", "cuda"):
        raise ConfigError(f"'device' must be cpu or cuda, got '{device}'")
    if device != "cpu" and not torch.cuda.is_available():
        raise ConfigError(f"device '{device}': this machine's torch sees no GPU; use cpu")
    checkpoint = load_checkpoint(SHIPPED_WEIGHTS if path is None else path)
    return Encoder(
        checkpoint.model,
        checkpoint.preprocessing,
        checkpoint.fingerprint,
        metadata=checkpoint.metadata,
        device=device,
        threads=threads,
    )
