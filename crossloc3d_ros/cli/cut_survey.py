"""`cut_survey`: make a small aerial file out of large ones, with positions and classes alone."""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from crossloc3d_ros.aerial_map.survey import read_survey
from crossloc3d_ros.cli.common import add_verbosity, console, run, set_up_logging
from crossloc3d_ros.errors import AerialDataError
from crossloc3d_ros.formats.las import LazWriter, iter_chunks


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command and return its exit code."""
    arguments = _parser().parse_args(argv)
    return run(lambda: _cut(arguments))


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="cut_survey",
        description="Write the points of an area, their positions and classes alone, into one LAZ file.",
    )
    parser.add_argument("files", nargs="+", help="LAS, LAZ or COPC files, folders with such files, globs")
    parser.add_argument("--output", required=True, type=Path, help="the file to be written, ending in .laz or .las")
    parser.add_argument(
        "--bounds", nargs=4, type=float, metavar=("WEST", "SOUTH", "EAST", "NORTH"),
        help="what to keep, in the files' CRS (default: everything)",
    )  # fmt: skip
    parser.add_argument("--scale", type=float, default=0.01, help="step of the coordinates (default: %(default)s)")
    parser.add_argument("--crs", help="CRS of the files, instead of what they say")
    add_verbosity(parser)
    return parser


def _cut(arguments: argparse.Namespace) -> None:
    set_up_logging(arguments.verbose, console())
    survey = read_survey(arguments.files, arguments.crs)
    west, south, east, north = arguments.bounds or (-np.inf, -np.inf, np.inf, np.inf)
    kept = 0
    with LazWriter(arguments.output, survey.crs, scale=arguments.scale, offset=np.floor(survey.minimum)) as writer:
        for header in survey.headers:
            for chunk in iter_chunks(header.path):
                e, n = chunk.points[:, 0], chunk.points[:, 1]
                inside = (e >= west) & (e < east) & (n >= south) & (n < north)
                writer.write(chunk.points[inside], chunk.classification[inside])
                kept += int(inside.sum())
        if kept == 0:
            raise AerialDataError("none of the files has a point within these bounds; nothing was written")
    print(f"{arguments.output}: {kept:,} points, {arguments.output.stat().st_size / 1e6:.2f} MB, {survey.crs}")


if __name__ == "__main__":
    raise SystemExit(main())
