"""Several processes and a Dask cluster build the map that one process builds, and die with their parent."""

from __future__ import annotations

import functools
import json
import multiprocessing
import os
import signal
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import psutil
import pytest

from crossloc3d_ros.aerial_map import store
from crossloc3d_ros.aerial_map.builder import build_map, work_folder
from crossloc3d_ros.aerial_map.progress import BuildProgress
from crossloc3d_ros.aerial_map.store import AerialMap
from crossloc3d_ros.config import BuildConfig
from crossloc3d_ros.encoder.checkpoint import load_encoder
from crossloc3d_ros.errors import AerialDataError, ConfigError, CrossLocError
from crossloc3d_ros.formats.las import write_laz


@pytest.fixture(scope="module")
def alone(survey_file: Path, weights: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The map as one process builds it."""
    output = tmp_path_factory.mktemp("maps") / "town"
    build_map([survey_file], output, load_encoder(weights), BuildConfig(tile_m=76.0))
    return output


def assert_same_map(ours: Path, theirs: Path) -> None:
    for name in (store.SUBMAPS, store.TERRAIN, store.SURFACE, store.LOWEST):
        assert (ours / name).read_bytes() == (theirs / name).read_bytes()
    a, b = AerialMap.load(ours), AerialMap.load(theirs)
    ids = np.arange(len(a.index))
    np.testing.assert_allclose(a.index.descriptors(ids), b.index.descriptors(ids), atol=1e-4)
    assert a.manifest.counts == b.manifest.counts


def test_several_processes_build_the_same_map(
    tmp_path: Path, survey: Any, weights: Path, survey_file: Path, alone: Path
) -> None:
    loader = functools.partial(load_encoder, weights, threads=1)
    before = dict(os.environ)
    build_map([survey_file], tmp_path / "town", loader, BuildConfig(tile_m=76.0, workers=2))
    assert_same_map(tmp_path / "town", alone)
    assert dict(os.environ) == before
    assert psutil.Process().children() == [] or all(
        "resource_tracker" in " ".join(child.cmdline()) for child in psutil.Process().children()
    )


def test_an_error_in_a_worker_is_the_callers_error(tmp_path: Path, weights: Path, survey_file: Path) -> None:
    bad = tmp_path / "bad.laz"
    bad.write_bytes(survey_file.read_bytes()[:-5000])
    loader = functools.partial(load_encoder, weights, threads=1)
    with pytest.raises(AerialDataError, match=r"bad\.laz is damaged"):
        build_map([bad], tmp_path / "town", loader, BuildConfig(workers=2))


def test_a_dask_cluster_builds_the_same_map(tmp_path: Path, weights: Path, survey_file: Path, alone: Path) -> None:
    distributed = pytest.importorskip("distributed")
    loader = functools.partial(load_encoder, weights, threads=1)
    with distributed.LocalCluster(
        n_workers=1, threads_per_worker=2, processes=False, dashboard_address=None, protocol="tcp://"
    ) as cluster:
        build_map(
            [survey_file], tmp_path / "town", loader, BuildConfig(tile_m=76.0), scheduler=cluster.scheduler_address
        )
    assert_same_map(tmp_path / "town", alone)


def test_no_scheduler_no_build(
    tmp_path: Path, survey_file: Path, encoder: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    pytest.importorskip("distributed")
    with monkeypatch.context() as patch:
        patch.setattr("crossloc3d_ros.workers._ANSWER_WITHIN_S", 1)
        with pytest.raises(ConfigError, match=r"no Dask scheduler responds at tcp://127\.0\.0\.1:9"):
            build_map([survey_file], tmp_path / "a", encoder, scheduler="tcp://127.0.0.1:9")
    monkeypatch.setitem(sys.modules, "distributed", None)
    with pytest.raises(ConfigError, match="pip install distributed"):
        build_map([survey_file], tmp_path / "b", encoder, scheduler="tcp://127.0.0.1:9")


BUILD = """
import functools, json, os, sys, time
from pathlib import Path
from crossloc3d_ros.config import BuildConfig
from crossloc3d_ros.encoder.checkpoint import load_encoder
from crossloc3d_ros.aerial_map.builder import build_map

def main():
    files, output, weights, workers = json.loads(sys.argv[1])
    loader = functools.partial(load_encoder, Path(weights), threads=1)
    build_map(files, output, loader, BuildConfig(tile_m=76.0, workers=workers), progress=lambda p: print(p, flush=True))

if __name__ == "__main__":
    main()
"""


@pytest.mark.slow
@pytest.mark.parametrize("how", [signal.SIGINT, signal.SIGKILL])
def test_workers_end_with_their_parent(tmp_path: Path, weights: Path, town: Any, how: signal.Signals) -> None:
    survey = town(600.0, 600.0)
    write_laz(tmp_path / "a.laz", survey.points, survey.classification, "EPSG:32631")
    (tmp_path / "build.py").write_text(BUILD)
    arguments = json.dumps([[str(tmp_path / "a.laz")], str(tmp_path / "map"), str(weights), 2])
    process = subprocess.Popen(
        [sys.executable, str(tmp_path / "build.py"), arguments],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )
    assert process.stdout is not None
    for line in process.stdout:
        if "encoding" in line and "done=0," not in line:
            break
    family = psutil.Process(process.pid).children(recursive=True)
    assert len(family) >= 2
    process.send_signal(how)
    process.communicate(timeout=30)
    _, alive = psutil.wait_procs(family, timeout=15)
    assert alive == []
    assert not (tmp_path / "map").exists() and any((work_folder(tmp_path / "map") / "tiles").glob("*.npz"))


@pytest.mark.slow
def test_a_worker_that_dies_is_said_and_loses_nothing(
    tmp_path: Path, weights: Path, survey_file: Path, alone: Path
) -> None:
    others = set(multiprocessing.active_children())
    killed = False

    def kill_one(progress: BuildProgress) -> None:
        nonlocal killed
        if progress.stage == "encoding" and progress.done > 0 and not killed:
            (set(multiprocessing.active_children()) - others).pop().kill()
            killed = True

    loader = functools.partial(load_encoder, weights, threads=1)
    config = BuildConfig(tile_m=76.0, workers=2)
    with pytest.raises(CrossLocError, match=r"a worker process died.*what is done is kept"):
        build_map([survey_file], tmp_path / "town", loader, config, progress=kill_one)
    assert build_map([survey_file], tmp_path / "town", load_encoder(weights), BuildConfig(tile_m=76.0)).resumed
    assert_same_map(tmp_path / "town", alone)


MEASURE = """
import resource, sys
sys.path.insert(0, sys.argv[1])
from pathlib import Path
import numpy as np
from conftest import PolarHistogram
from crossloc3d_ros.config import BuildConfig
from crossloc3d_ros.aerial_map.builder import build_map
report = build_map([sys.argv[2]], sys.argv[3], PolarHistogram(), BuildConfig(tile_m=190.0, chunk_points=200_000))
print(report.manifest.counts.points_used, resource.getrusage(resource.RUSAGE_SELF).ru_maxrss)
"""


@pytest.mark.slow
def test_memory_does_not_grow_with_the_area(tmp_path: Path, town: Any) -> None:
    peaks = {}
    for side in (1, 3):
        folder = tmp_path / f"survey_{side}"
        folder.mkdir()
        for column in range(side):
            for row in range(side):
                survey = town(500.0, 500.0, 4.0, seed=column * 10 + row)
                shifted = survey.points + np.array([500.0 * column, 500.0 * row, 0.0])
                write_laz(folder / f"{column}_{row}.laz", shifted, survey.classification, "EPSG:32631")
        arguments = [str(Path(__file__).parent), str(folder), str(tmp_path / f"map_{side}")]
        finished = subprocess.run(
            [sys.executable, "-c", MEASURE, *arguments], capture_output=True, text=True, check=True, timeout=250
        )
        points, peak_kb = map(int, finished.stdout.split())
        assert points == side * side * 1_000_000
        peaks[side] = peak_kb / 1024
    # Nine times the points: 8 million more, 200 MB as float64. What may grow is the bookkeeping of the tiles.
    assert peaks[3] < peaks[1] + 40, peaks
