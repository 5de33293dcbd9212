"""`make bench`: latencies and rates of every part, beside the machine's own matrix-multiply peak.

Run it on a machine that does nothing else. The demo's map and a short drive are made on the way; the figures go to
`bench.json` and to the screen.
"""

from __future__ import annotations

import argparse
import json
import os
import platform
import resource
import shutil
import time
from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np
import torch
from rich.console import Console
from rich.table import Table

from bench.alignment import bench_alignment
from bench.figure import Figure, median_ms
from bench.flops import descriptor_flops
from bench.simulation import bench_simulation
from crossloc3d_ros.aerial_map.builder import build_map
from crossloc3d_ros.aerial_map.descriptor_map import DescriptorMap
from crossloc3d_ros.aerial_map.store import AerialMap
from crossloc3d_ros.cli.common import ProgressDisplay, console, run
from crossloc3d_ros.clouds.scan import PreparedScan, prepare_scan
from crossloc3d_ros.config import ScanConfig
from crossloc3d_ros.datasets.amsterdam import DRIVE_SURVEY, MAP_SURVEY, find_surveys
from crossloc3d_ros.datasets.amsterdam_drive import TOPIC, DemoDrive, make_drive
from crossloc3d_ros.encoder.checkpoint import load_encoder
from crossloc3d_ros.encoder.model import CAMPUS, CrossLoc3D
from crossloc3d_ros.encoder.runtime import Encoder
from crossloc3d_ros.formats.bag import open_bag
from crossloc3d_ros.formats.pointcloud2 import scan_from_pointcloud2

SEARCHED = (27_520, 1_000_000)
"""Sizes of map to search besides the real one: the published dataset's, and a state's."""


def main(argv: Sequence[str] | None = None) -> int:
    """Run the benchmark."""
    parser = argparse.ArgumentParser(prog="bench", description=__doc__)
    parser.add_argument("--output", type=Path, default=Path("out/bench"), help="folder (default: %(default)s)")
    parser.add_argument("--weights", type=Path, help="weights file (default: the one that comes with the package)")
    parser.add_argument("--only", choices=("simulation",), help="measure this part alone")
    parser.add_argument("--runs", type=int, default=40, help="repetitions of each timing (default: %(default)s)")
    arguments = parser.parse_args(argv)
    return run(lambda: _bench(arguments))


def _bench(arguments: argparse.Namespace) -> None:
    output: Path = arguments.output
    output.mkdir(parents=True, exist_ok=True)
    target = console()
    if arguments.only == "simulation":
        _finish(bench_simulation(), output, target)
        return
    encoder = load_encoder(arguments.weights)
    began = time.perf_counter()
    encoder.warm_up()
    figures = [Figure("encoder: compile and warm up", time.perf_counter() - began, "s", note="compiled code is cached")]
    peak = matrix_peak()
    figures += [Figure(f"matrix product, float32, {n} threads", value, "GFLOP/s") for n, value in peak.items()]
    fastest = max(peak.values())

    figures += bench_builder(find_surveys(None) / MAP_SURVEY, output / "map", encoder, target)
    plan = DemoDrive(length_m=120.0)
    with ProgressDisplay(target) as display:
        make_drive(find_surveys(None) / DRIVE_SURVEY, output / "drive", plan, target.print, display)
    published = Encoder(CrossLoc3D(CAMPUS), encoder.preprocessing, "published")  # its size decides, not its weights
    figures += bench_golden(published, fastest, arguments.runs)
    figures += bench_scan(output / "drive", encoder, published, fastest, arguments.runs)
    aerial_map = AerialMap.load(output / "map", encoder.fingerprint)
    figures += bench_search(aerial_map, arguments.runs)
    figures += bench_alignment(aerial_map, prepared_scans(output / "drive", encoder), arguments.runs)
    figures += bench_node(output, aerial_map, arguments.weights)
    figures += bench_simulation()
    _finish(figures, output, target)


def _finish(figures: list[Figure], output: Path, target: Console) -> None:
    """Show the figures and write them down."""
    peak_mb = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
    figures.append(Figure("memory of this process at most", peak_mb, "MB"))
    show(figures)
    record = {"machine": machine(), "figures": [asdict(figure) for figure in figures]}
    (output / "bench.json").write_text(json.dumps(record, indent=2))
    target.print(f"written to {output / 'bench.json'}")


def matrix_peak(size: int = 1536) -> dict[int, float]:
    """Return the best GFLOP/s of a float32 matrix product, with one thread and with all."""
    a, b = torch.randn(size, size), torch.randn(size, size)
    before = torch.get_num_threads()
    peak = {}
    for threads in sorted({1, len(os.sched_getaffinity(0))}):
        torch.set_num_threads(threads)
        times = []
        for _ in range(12):
            began = time.perf_counter()
            torch.mm(a, b)
            times.append(time.perf_counter() - began)
        peak[threads] = 2.0 * size**3 / min(times) / 1e9
    torch.set_num_threads(before)
    return peak


def _encoding(name: str, clouds: list[Any], encoder: Encoder, peak: float, runs: int, target: str) -> Figure:
    turn = iter(range(10**9))
    value = median_ms(lambda: encoder.encode(clouds[next(turn) % len(clouds)]), runs)
    gflop = float(np.median([descriptor_flops(cloud, encoder.model_config) for cloud in clouds])) / 1e9
    return Figure(name, value, "ms", target, gflop / (value / 1e3) / peak, f"{gflop:.2f} GFLOP")


def bench_golden(encoder: Encoder, peak: float, runs: int) -> list[Figure]:
    """Time the published network's densest golden cloud."""
    cloud = np.load(Path(__file__).resolve().parents[1] / "test/encoder/golden/golden_descriptors.npz")["clouds"][0]
    return [_encoding("published network: golden cloud campus_ground", [cloud], encoder, peak, runs, "30, goal 15")]


def bench_scan(bag_path: Path, encoder: Encoder, published: Encoder, peak: float, runs: int) -> list[Figure]:
    """Time what happens to one scan on the way to its descriptor."""
    with open_bag(bag_path) as bag:
        messages = [message.message for message in bag.messages([TOPIC])][::5][:24]
    scans = [scan_from_pointcloud2(message) for message in messages]
    config, preprocessing = ScanConfig(), encoder.preprocessing
    patches = [prepared.patch.points for scan in scans if (prepared := prepare_scan(scan, config, preprocessing)).patch]
    points = int(np.median([len(scan.points) for scan in scans]))
    turn = iter(range(10**9))
    reading = median_ms(lambda: scan_from_pointcloud2(messages[next(turn) % len(messages)]), runs)
    preparing = median_ms(lambda: prepare_scan(scans[next(turn) % len(scans)], config, preprocessing), runs)
    return [
        Figure("scan: read the message", reading, "ms", note=f"{points:,} points"),
        Figure("scan: filter, level, remove ground, patch", preparing, "ms", "10", note=f"{points:,} points"),
        _encoding("published network: scan over +-50 m", patches, published, peak, runs, "15, goal 8"),
        _encoding("shipped network: scan over +-50 m", patches, encoder, peak, runs, "15, goal 8"),
    ]


def prepared_scans(bag_path: Path, encoder: Encoder) -> list[PreparedScan]:
    """Return some scans of a drive as the localizer prepares them."""
    with open_bag(bag_path) as bag:
        messages = [message.message for message in bag.messages([TOPIC])][::12][:10]
    return [prepare_scan(scan_from_pointcloud2(message), ScanConfig(), encoder.preprocessing) for message in messages]


def bench_builder(survey: Path, output: Path, encoder: Encoder, target: Console) -> list[Figure]:
    """Time the building of the real Amsterdam map."""
    for folder in (output, output.with_name(f"{output.name}.build")):
        shutil.rmtree(folder, ignore_errors=True)
    with ProgressDisplay(target) as display:
        report = build_map([survey], output, encoder, progress=lambda p: display(p.stage, p.done, p.total, p.unit))
    return [
        Figure("builder: points read", report.points_per_s, "points/s"),
        Figure(
            "builder: submaps", report.submaps_per_s, "submaps/s", note=f"{report.manifest.counts.submaps:,} submaps"
        ),
    ]


def bench_search(aerial_map: AerialMap, runs: int) -> list[Figure]:
    """Time the search for 25 candidates in the real map and in larger ones of the same descriptors with noise."""
    rng = np.random.default_rng(0)
    real = aerial_map.index.descriptors(np.arange(len(aerial_map.index)))
    indices = [aerial_map.index]
    for count in SEARCHED:
        noise = rng.standard_normal((count, real.shape[1]), np.float32) * real.std()
        indices.append(DescriptorMap(real[rng.integers(0, len(real), count)] + noise))

    def figure(index: DescriptorMap) -> Figure:
        turn = iter(range(10**9))
        value = median_ms(lambda: index.search(real[next(turn) % len(real)], 25), runs)
        return Figure(f"search: 25 candidates of {len(index):,} submaps", value, "ms")

    return [figure(index) for index in indices]


def bench_node(output: Path, aerial_map: AerialMap, weights: Path | None) -> list[Figure]:
    """Play the drive at 10 Hz into the real node over DDS."""
    from crossloc3d_ros.evaluation.drives.estimates import read_estimates
    from crossloc3d_ros.replay.live import localize_live

    parameters = {} if weights is None else {"weights": str(weights.resolve())}
    with open_bag(output / "drive") as bag:
        live = localize_live(
            bag, TOPIC, output / "map", aerial_map.frame, output / "estimates.csv",
            odometry_topic="/odom", parameters=parameters, log_path=output / "localizer.log",
        )  # fmt: skip
    latencies = read_estimates(output / "estimates.csv").timings_ms[:, -1]  # from publishing to receiving the fix
    known = latencies[np.isfinite(latencies)]
    return [
        Figure("node: start until it listens", live.startup_s, "s"),
        Figure("node: message to fix, median", float(np.median(known)), "ms", "100"),
        Figure("node: message to fix, 95 %", float(np.percentile(known, 95)), "ms"),
        Figure(
            "node: scans without an estimate",
            float(live.scans - live.estimates),
            "scans",
            "0",
            note=f"of {live.scans:,}",
        ),
    ]


def machine() -> dict[str, str]:
    """Return what the figures were measured on."""
    model = platform.processor() or platform.machine()
    info = Path("/proc/cpuinfo")
    if info.is_file():
        model = next(
            (line.split(":")[1].strip() for line in info.read_text().splitlines() if "model name" in line), model
        )
    return {
        "processor": model,
        "cores": str(len(os.sched_getaffinity(0))),
        "python": platform.python_version(),
        "torch": torch.__version__,
    }


def show(figures: Sequence[Figure]) -> None:
    """Print the figures as a table."""
    table = Table(title=f"crossloc3d_ros on {machine()['processor']}, {machine()['cores']} cores", title_justify="left")
    for name, justify in (("what", "left"), ("value", "right"), ("unit", "left"), ("at most", "right")):
        table.add_column(name, justify=justify)  # type: ignore[arg-type]
    table.add_column("of the peak", justify="right")
    table.add_column("note")
    for figure in figures:
        share = "" if figure.share_of_peak is None else f"{100 * figure.share_of_peak:.0f} %"
        table.add_row(figure.name, f"{figure.value:,.4g}", figure.unit, figure.target, share, figure.note)
    Console(highlight=False, width=120).print(table)


if __name__ == "__main__":
    raise SystemExit(main())
