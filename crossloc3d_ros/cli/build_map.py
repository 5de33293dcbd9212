"""`build_map`: make an aerial map out of LAS, LAZ and COPC files."""

from __future__ import annotations

import argparse
import dataclasses
import functools
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from crossloc3d_ros.aerial_map.builder import BuildReport, build_map
from crossloc3d_ros.aerial_map.coverage import SPARSE_PER_M2, Coverage, coverage_warnings
from crossloc3d_ros.aerial_map.store import Manifest
from crossloc3d_ros.aerial_map.survey import Survey
from crossloc3d_ros.cli.common import (
    ProgressDisplay,
    add_options,
    add_verbosity,
    console,
    read_options,
    run,
    set_up_logging,
)
from crossloc3d_ros.config import BuildConfig, LocalizabilityConfig
from crossloc3d_ros.encoder.checkpoint import load_encoder
from crossloc3d_ros.errors import ConfigError
from crossloc3d_ros.geodesy import MapFrame, crs_name
from crossloc3d_ros.placement import datum_warnings, datum_words, place_words, unit_name, unit_of

_CALIBRATION_OPTIONS = ("lidar", "lidar_height_m", "places", "off_map_scans", "seed")
"""Of `calibrate_map`; the workers are those of the build."""


def main(argv: Sequence[str] | None = None) -> int:
    """Run the command and return its exit code."""
    arguments = _parser().parse_args(argv)
    return run(lambda: _build(arguments))


def _parser() -> argparse.ArgumentParser:
    parser = argparse.ArgumentParser(
        prog="build_map",
        description="Build an aerial map that a robot can be localized in. An interrupted build continues "
        "when the same command is given again.",
    )
    parser.add_argument("files", nargs="+", help="LAS, LAZ or COPC files, folders with such files, globs")
    parser.add_argument("--output", required=True, type=Path, help="the map's folder, such as maps/town")
    parser.add_argument("--crs", help="CRS of the files, instead of what they say, such as EPSG:28992")
    parser.add_argument("--weights", type=Path, help="weights file (default: the one that comes with the package)")
    parser.add_argument("--device", default="cpu", help="where to encode: cpu or cuda (default: %(default)s)")
    parser.add_argument("--scheduler", help="address of a Dask cluster that sees the same folders, tcp://host:8786")
    parser.add_argument("--overwrite", action="store_true", help="replace the map if there is one")
    parser.add_argument(
        "--geoid-separation", type=float, metavar="METRES",
        help="ellipsoidal height minus the survey's height; without it fixes carry no altitude",
    )  # fmt: skip
    add_options(parser, BuildConfig)
    parser.add_argument(
        "--calibrate", action="store_true", help="then calibrate the map as calibrate_map does, for the lidar given"
    )
    add_options(parser, LocalizabilityConfig, _CALIBRATION_OPTIONS)
    add_verbosity(parser)
    return parser


def _build(arguments: argparse.Namespace) -> None:
    config = read_options(BuildConfig, arguments)
    calibration = _calibration_of(arguments, config)
    target = console()
    set_up_logging(arguments.verbose, target)
    one_thread_each = config.workers > 1 or arguments.scheduler is not None
    loader = functools.partial(
        load_encoder, arguments.weights, device=arguments.device, threads=1 if one_thread_each else None
    )
    with ProgressDisplay(target) as display:
        report = build_map(
            arguments.files,
            arguments.output,
            loader,
            config,
            crs=arguments.crs,
            geoid_separation_m=arguments.geoid_separation,
            scheduler=arguments.scheduler,
            overwrite=arguments.overwrite,
            progress=lambda p: display(p.stage, p.done, p.total, p.unit),
        )
        print(summary(report))
        if calibration is not None:
            from crossloc3d_ros.cli.calibrate_map import calibrate_and_sum_up

            print(calibrate_and_sum_up(arguments.output, loader, calibration, display))


def _calibration_of(arguments: argparse.Namespace, config: BuildConfig) -> LocalizabilityConfig | None:
    """Return how the map is to be calibrated, if at all; ConfigError for options that do nothing or cannot be."""
    given = [name for name in _CALIBRATION_OPTIONS if getattr(arguments, name) is not None]
    if not arguments.calibrate:
        if given:
            raise ConfigError(f"--{given[0].replace('_', '-')} is of use with --calibrate alone")
        return None
    calibration = read_options(LocalizabilityConfig, arguments)
    from crossloc3d_ros.localizability.driving import Sensor  # what simulates is not needed to build

    Sensor(calibration)  # an unknown lidar is reported before the build, not after it
    return dataclasses.replace(calibration, workers=config.workers)


def summary(report: BuildReport) -> str:
    """Return what a build came to, for people."""
    manifest, counts = report.manifest, report.manifest.counts
    west, south, east, north = manifest.bounds
    ground = {
        "classes": "class 2 of the files",
        "filter": "own filter, because the files have no ground class",
        "classes and filter": "class 2 of the files where they have it, own filter elsewhere",
    }[manifest.ground]
    left_out = counts.submaps_with_too_few_points
    dropped = counts.points_noise + counts.points_withheld + counts.points_stray
    rows = [
        ("map", f"{report.output}{' (an earlier build was continued)' if report.resumed else ''}"),
        ("place", _place(manifest)),
        ("area", f"{(east - west) / 1e3:.2f} x {(north - south) / 1e3:.2f} km, {manifest.crs}"),
        ("survey", f"{crs_name(report.survey.crs)}; {_units(report.survey)}"),
        ("accuracy", datum_words(report.survey.datum)),
        ("points", f"{counts.points_used:,} used, {dropped:,} dropped (noise, withheld, stray)"),
        *_covered(manifest.coverage),
        ("ground", ground),
        ("heights", _heights(report)),
        (
            "submaps",
            f"{counts.submaps:,} every {manifest.build.spacing_m:g} m; {left_out:,} left out for lack of points",
        ),
        ("reading", f"{report.points_read:,} points in {report.reading_s:.1f} s, {report.points_per_s:,.0f} a second"),
        (
            "encoding",
            f"{report.submaps_encoded:,} submaps in {report.encoding_s:.1f} s, {report.submaps_per_s:,.1f} a second",
        ),
        ("writing", f"{report.writing_s:.1f} s"),
        *(("warning", text) for text in datum_warnings(report.survey.datum)),
        *(("warning", text) for text in (coverage_warnings(manifest.coverage) if manifest.coverage else ())),
    ]
    return "\n".join(f"{name:<9} {text}" for name, text in rows)


def _place(manifest: Manifest) -> str:
    """Return where the middle of the map is, with a link that shows it."""
    frame = MapFrame(manifest.crs, np.array(manifest.origin))
    latitude, longitude, _ = (float(value[0]) for value in frame.to_geographic(np.array([manifest.origin])))
    at = f"{latitude:.5f}/{longitude:.5f}"
    link = f"https://www.openstreetmap.org/?mlat={latitude:.5f}&mlon={longitude:.5f}#map=15/{at}"
    return f"{place_words(latitude, longitude)}, {link}"


def _units(survey: Survey) -> str:
    unit_m = unit_of(survey.crs)
    horizontal = "degree" if unit_m is None else unit_name(unit_m)
    return f"unit of x and y: {horizontal}, of heights: {unit_name(survey.vertical.metres_per_unit)}"


def _covered(coverage: Coverage | None) -> list[tuple[str, str]]:
    """Return how densely and how completely the survey covers the area."""
    if coverage is None:
        return []
    sparse = f"; sparse, as all below {SPARSE_PER_M2:g}" if coverage.points_per_m2 < SPARSE_PER_M2 else ""
    gaps = f"{coverage.gap_share:.1%} in gaps or water"
    if coverage.widest_gap_m > 0:
        gaps += f", up to {coverage.widest_gap_m:.0f} m wide"
    return [
        (
            "density",
            f"{coverage.points_per_m2:.2g} points/m2, {coverage.points_per_m2_low:.2g} in the thinnest 5 %{sparse}",
        ),
        ("cells", f"{coverage.empty_share:.0%} without an echo ({gaps}); {coverage.wood_share:.0%} of the area wood"),
    ]


def _heights(report: BuildReport) -> str:
    manifest = report.manifest
    if manifest.geoid_separation_m is None:
        return f"above {manifest.vertical_reference} datum; no altitude in fixes without --geoid-separation"
    return f"above {manifest.vertical_reference} datum, {manifest.geoid_separation_m:+.2f} m to the ellipsoid"


if __name__ == "__main__":
    raise SystemExit(main())
