"""`import_checkpoint`: turn the authors' torch file into this package's weights."""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from pathlib import Path

from crossloc3d_ros.cli.common import run
from crossloc3d_ros.config import PreprocessingConfig

PUBLISHED = PreprocessingConfig(
    half_extent_m=100.0,
    scan_half_extent_m=20.0,
    scan_origin="mean",
    submap_origin="bounding_box",
    vertical_origin="centre",
    ground_clearance_m=0.0,
    thin_m=0.0,
)
"""The scales of CS-Campus3D: aerial coordinates times 100 m, ground coordinates times 20 m about their mean."""


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command."""
    arguments = _parser().parse_args(argv)
    return run(lambda: _import(arguments))


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="import_checkpoint", description="Turn the authors' torch file into this package's weights."
    )
    parser.add_argument("checkpoint", type=Path, help="the authors' .pth file (701 tensors in 'model_state_dict')")
    parser.add_argument("--output", type=Path, required=True, help="the .safetensors file to write")
    parser.add_argument("--preset", choices=("campus", "oxford"), default="campus", help="the model that it holds")
    parser.add_argument("--float32", action="store_true", help="keep full precision (twice the size)")
    return parser


def _import(arguments: argparse.Namespace) -> int:
    from crossloc3d_ros.encoder.checkpoint import load_checkpoint, save_checkpoint
    from crossloc3d_ros.encoder.model import PRESETS
    from crossloc3d_ros.encoder.release import read_release

    model = read_release(arguments.checkpoint, PRESETS[arguments.preset])
    source = {"training": f"imported from {arguments.checkpoint.name}"}
    save_checkpoint(arguments.output, model, PUBLISHED, source, dtype="float32" if arguments.float32 else "float16")
    written = load_checkpoint(arguments.output)
    parameters = sum(p.numel() for p in written.model.parameters())
    print(f"wrote {arguments.output}: {parameters:,} parameters, fingerprint {written.fingerprint}")
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
