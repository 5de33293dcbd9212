"""The authors' released checkpoint: its 701 keys and what we call the same tensors."""

from __future__ import annotations

import pickle
from collections.abc import Mapping
from pathlib import Path

import torch
from torch import Tensor

from crossloc3d_ros.config import ModelConfig
from crossloc3d_ros.encoder.model import CAMPUS, CrossLoc3D
from crossloc3d_ros.errors import CheckpointError

_NORM = ("weight", "bias", "running_mean", "running_var", "num_batches_tracked")
_ALIASES = ("up_conv0", "up_convs", "up_blocks")
"""Second names, in the release's state dict, of the tensors of the last entry of the list of the same name."""


def release_names(config: ModelConfig = CAMPUS) -> dict[str, str]:
    """Return {our key: the release's key} for every tensor of the model, aliases left out."""
    names: dict[str, str] = {}
    for i in range(len(config.voxel_sizes)):
        names |= _grain_names(i)
    names |= _refinement_names(len(config.voxel_sizes) * config.sub_steps)
    names["fusion.weight"] = "backbone.conv_fuse.0.weight"
    names |= _norm("fusion_norm", "backbone.conv_fuse.1")
    names["pooling.assignment"] = "pool.net_vlad.cluster_weights"
    names["pooling.centers"] = "pool.net_vlad.cluster_weights2"
    names["pooling.projection"] = "pool.net_vlad.hidden1_weights"
    names["pooling.gating"] = "pool.net_vlad.context_gating.gating_weights"
    names |= _norm("pooling.assignment_norm", "pool.net_vlad.bn1")
    names |= _norm("pooling.output_norm", "pool.net_vlad.bn2")
    names |= _norm("pooling.gating_norm", "pool.net_vlad.context_gating.bn1")
    return names


def _grain_names(i: int) -> dict[str, str]:
    names = _convolution(f"grains.{i}.stem", f"backbone.up_conv0_lst.{i}")
    names |= _convolution(f"grains.{i}.down", f"backbone.up_convs_lst.{i}.0")
    block, ours = f"backbone.up_blocks_lst.{i}.0", f"grains.{i}.selection"
    for branch, layers in enumerate((0, 2, 2, 3, 3)):
        size = 1 + 2 * branch
        for layer in range(layers):
            names |= _convolution(f"{ours}.branches.{branch}.{layer}", f"{block}.conv{size}x{size}", 3 * layer)
        names[f"{ours}.attentions.{branch}.conv.weight"] = f"{block}.eca{size}x{size}.conv.weight"
        for layer in range(2):
            names |= _convolution(f"{ours}.transforms.{branch}.{layer}", f"{block}.trans_layers.{branch}", 3 * layer)
    return names | _convolution(f"{ours}.gate", f"{block}.trans_layer2")


def _refinement_names(steps: int) -> dict[str, str]:
    transformer = "backbone.diff_transformer"
    names = {"refinement.time.frequencies": f"{transformer}.time_mlp.0.weights"}
    for part in ("weight", "bias"):
        names[f"refinement.time.first.{part}"] = f"{transformer}.time_mlp.1.{part}"
        names[f"refinement.time.second.{part}"] = f"{transformer}.time_mlp.3.{part}"
    for t in range(steps):
        ours, theirs = f"refinement.layers.{t}", f"{transformer}.attn_layers.{t}"
        names[f"{ours}.centers"] = f"{theirs}.centers"
        names[f"{ours}.query.weight"] = f"{theirs}.q_conv.weight"
        for mine, release in (("value", "v_conv"), ("transform", "trans_conv")):
            for part in ("weight", "bias"):
                names[f"{ours}.{mine}.{part}"] = f"{theirs}.{release}.{part}"
        names |= _norm(f"{ours}.norm", f"{theirs}.after_norm")
    return names


def _norm(ours: str, theirs: str) -> dict[str, str]:
    return {f"{ours}.{part}": f"{theirs}.{part}" for part in _NORM}


def _convolution(ours: str, theirs: str, position: int = 0) -> dict[str, str]:
    """Return the names of a convolution at a position of a sequence, and of the batch norm behind it."""
    return {f"{ours}.weight": f"{theirs}.{position}.kernel", **_norm(f"{ours}.norm", f"{theirs}.{position + 1}.bn")}


def release_aliases(config: ModelConfig = CAMPUS) -> dict[str, str]:
    """Return {alias: the key whose tensor it names again}, both in the release's terms."""
    last = len(config.voxel_sizes) - 1
    aliases = {}
    for key in release_names(config).values():
        for stem in _ALIASES:
            prefix = f"backbone.{stem}_lst.{last}."
            if key.startswith(prefix):
                aliases[f"backbone.{stem}.{key.removeprefix(prefix)}"] = key
    return aliases


def from_release(state: Mapping[str, Tensor], config: ModelConfig = CAMPUS) -> CrossLoc3D:
    """Build the model from the release's state dict; every tensor must be there, fit, and be known."""
    names, aliases = release_names(config), release_aliases(config)
    state = {key.removeprefix("module."): value for key, value in state.items()}
    missing = sorted(set(names.values()) - set(state))
    unknown = sorted(set(state) - set(names.values()) - set(aliases))
    problems = []
    if missing:
        problems.append(f"{len(missing)} tensors are missing: {_some(missing)}")
    if unknown:
        problems.append(f"{len(unknown)} tensors are unknown: {_some(unknown)}")
    for alias, key in aliases.items():
        if alias in state and key in state and not torch.equal(state[alias], state[key]):
            problems.append(f"'{alias}' should be a second name of '{key}' but differs from it")
            break
    if problems:
        raise CheckpointError("not a CrossLoc3D checkpoint of this model: " + "; ".join(problems))
    model = CrossLoc3D(config)
    ours = {}
    for key, tensor in model.state_dict().items():
        value = state[names[key]]
        if value.numel() != tensor.numel():
            raise CheckpointError(
                f"'{names[key]}' has shape {tuple(value.shape)}, this model needs {tuple(tensor.shape)}"
            )
        ours[key] = value.reshape(tensor.shape).to(tensor.dtype)
    model.load_state_dict(ours)
    return model.eval()


def read_release(path: Path, config: ModelConfig = CAMPUS) -> CrossLoc3D:
    """Read the authors' torch file without running any code in it."""
    try:
        content = torch.load(path, map_location="cpu", weights_only=True)
    except FileNotFoundError as error:
        raise CheckpointError(f"no such checkpoint: {path}") from error
    except (pickle.UnpicklingError, RuntimeError, EOFError, OSError, ValueError) as error:
        first_line = (str(error).splitlines() or [type(error).__name__])[0]
        raise CheckpointError(f"cannot read {path} as a torch checkpoint of plain tensors: {first_line}") from error
    if not isinstance(content, dict):
        raise CheckpointError(f"{path} holds a {type(content).__name__}, not the release's dictionary")
    state = content.get("model_state_dict", content)
    if not isinstance(state, dict) or not all(isinstance(value, Tensor) for value in state.values()):
        raise CheckpointError(f"{path} has no 'model_state_dict' of tensors; found: {_some(sorted(map(str, content)))}")
    return from_release(state, config)


def _some(names: list[str], count: int = 3) -> str:
    shown = ", ".join(f"'{name}'" for name in names[:count])
    return shown + (f" and {len(names) - count} more" if len(names) > count else "")
