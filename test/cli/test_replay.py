"""The command: results on disk, and one line for everything that can be wrong."""

from __future__ import annotations

import contextlib
import csv
import io
import json
import os
import shutil
import signal
import subprocess
import sys
import time
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pytest

from crossloc3d_ros.cli import replay
from crossloc3d_ros.config import BuildConfig, LocalizerNodeConfig, ModelConfig, PreprocessingConfig, from_dict
from crossloc3d_ros.config.sources import read_node_config
from crossloc3d_ros.errors import BagError, ConfigError
from crossloc3d_ros.formats import bag, messages
from crossloc3d_ros.replay import sources

SMALL_MODEL = ModelConfig(
    channels=16, fused_channels=64, clusters=8, descriptor_size=32, memory_sizes=(32, 16, 16, 16, 8, 8, 8, 8, 8)
)
EVERY = "5"


@dataclass(frozen=True)
class Installation:
    """What a user has: weights, a map that they made, a recording."""

    weights: Path
    map: Path
    bag: Path

    def arguments(self, output: Path, *more: str) -> list[str]:
        paths = ["--map", str(self.map), "--weights", str(self.weights), "--output", str(output)]
        return [str(self.bag), *paths, "--every", EVERY, *more]


@pytest.fixture(scope="module")
def installed(town_drive, tmp_path_factory: pytest.TempPathFactory) -> Installation:
    import torch

    from crossloc3d_ros.aerial_map.builder import build_map
    from crossloc3d_ros.encoder.checkpoint import load_encoder, save_checkpoint
    from crossloc3d_ros.encoder.model import CrossLoc3D

    folder = tmp_path_factory.mktemp("installed")
    torch.manual_seed(0)
    preprocessing = PreprocessingConfig(half_extent_m=30.0, scan_half_extent_m=30.0, n_points=512, min_points=40)
    save_checkpoint(folder / "weights.safetensors", CrossLoc3D(SMALL_MODEL), preprocessing, dtype="float32")
    encoder = load_encoder(folder / "weights.safetensors", threads=1)
    build_map([town_drive.survey], folder / "map", encoder, BuildConfig(spacing_m=38.0))
    return Installation(folder / "weights.safetensors", folder / "map", town_drive.bag)


@pytest.fixture(scope="module")
def results(installed: Installation, tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, str]:
    """The results of one run, and what it said."""
    folder = tmp_path_factory.mktemp("results") / "out"
    said = io.StringIO()
    with contextlib.redirect_stdout(said):
        assert replay.main(installed.arguments(folder)) == 0
    return folder, said.getvalue()


def rows_of(folder: Path) -> list[dict[str, str]]:
    with (folder / "estimates.csv").open(newline="") as file:
        return list(csv.DictReader(file))


def test_results_are_written_and_said(results: tuple[Path, str], town_drive) -> None:
    folder, said = results
    rows = rows_of(folder)
    assert [int(row["stamp_ns"]) for row in rows] == town_drive.stamps_ns[:: int(EVERY)].tolist()
    assert sum(row["truth_easting_m"] != "" for row in rows) >= len(rows) - 1
    summary = json.loads((folder / "summary.json").read_text())
    assert summary["scans"] == len(rows)
    assert json.loads((folder / "estimates.geojson").read_text())["type"] == "FeatureCollection"
    assert "/gnss" in (folder / "index.html").read_text()
    for word in (str(folder / "index.html"), "AR@1", "AR@5", "AR@25", "within 25 m", "chance", "error of"):
        assert word in said


def test_the_same_command_gives_the_same_estimates(
    installed: Installation, results: tuple[Path, str], tmp_path: Path
) -> None:
    assert replay.main(installed.arguments(tmp_path)) == 0
    timings = {"prepare_ms", "encode_ms", "search_ms", "align_ms", "fuse_ms", "latency_ms"}
    first, second = (
        [{k: v for k, v in row.items() if k not in timings} for row in rows_of(folder)]
        for folder in (results[0], tmp_path)
    )
    assert first == second


def test_map_and_weights_may_stand_in_the_parameter_file(installed: Installation, tmp_path: Path) -> None:
    parameters = f"/**:\n  ros__parameters: {{map: {installed.map}, weights: {installed.weights}, top_k: 4}}\n"
    (tmp_path / "localizer.yaml").write_text(parameters)
    arguments = [str(installed.bag), "--config", str(tmp_path / "localizer.yaml"), "--every", "20"]
    assert replay.main([*arguments, "--output", str(tmp_path / "out")]) == 0
    assert all(len(row["candidate_ids"].split()) == 4 for row in rows_of(tmp_path / "out"))


@pytest.mark.parametrize(
    "name",
    [
        "tepic_vlp16_outdoor_1scan_pointcloud2_mcap",
        pytest.param("einride_vlp16_pointcloud2_mcap", marks=pytest.mark.slow),
        pytest.param("einride_vlp16_pointcloud2_sqlite3", marks=pytest.mark.slow),
        pytest.param("nebula_vlp16_pointcloud2_mcap", marks=pytest.mark.slow),
    ],
)
def test_a_real_recording_from_elsewhere_is_replayed(
    installed: Installation, tmp_path: Path, shared, name: str
) -> None:
    elsewhere = Installation(installed.weights, installed.map, shared(f"data/vlp16/{name}"))
    assert replay.main(elsewhere.arguments(tmp_path)) == 0
    summary = json.loads((tmp_path / "summary.json").read_text())
    assert summary["scans"] >= 1
    assert summary["scores"] is None  # it carries no GNSS


def fails(capsys: pytest.CaptureFixture[str], arguments: list[str]) -> str:
    """Return the one line on stderr with which the command refuses."""
    capsys.readouterr()
    assert replay.main(arguments) == 2
    captured = capsys.readouterr()
    errors = [line for line in captured.err.splitlines() if line.startswith("error: ")]
    assert len(errors) == 1
    assert "Traceback" not in captured.err
    return errors[0]


def test_bad_input_is_refused_in_one_line(
    installed: Installation, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "out"
    missing = Installation(installed.weights, installed.map, tmp_path / "nothing")
    assert "does not exist" in fails(capsys, missing.arguments(out))
    assert "its topics are: /gnss" in fails(capsys, installed.arguments(out, "--topic", "/points"))
    assert "its topics are: /gnss" in fails(capsys, installed.arguments(out, "--gnss-topic", "/gps"))
    assert "its topics are: /gnss" in fails(capsys, installed.arguments(out, "--imu-topic", "/imu"))
    assert "holds sensor_msgs/msg/NavSatFix" in fails(capsys, installed.arguments(out, "--topic", "/gnss"))
    assert "its topics are: /gnss" in fails(capsys, installed.arguments(out, "--odom-topic", "/wheels"))
    assert "has no topic of type nav_msgs/msg/Odometry" in fails(
        capsys, installed.arguments(out, "--odometry", "topic")
    )
    told = installed.arguments(out, "--odometry", "scan", "--odom-topic", "/odom")
    assert "--odom-topic has no meaning with --odometry scan" in fails(capsys, told)
    assert "--every must be at least 1" in fails(capsys, [*installed.arguments(out), "--every", "0"])
    assert "'scan.mounting.z_m' must lie between" in fails(capsys, installed.arguments(out, "--z-m", "1e6"))
    no_map = Installation(installed.weights, tmp_path, installed.bag)
    assert "manifest.json" in fails(capsys, no_map.arguments(out))
    assert not out.exists()


def test_a_map_of_other_weights_is_refused(
    installed: Installation, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    import torch

    from crossloc3d_ros.encoder.checkpoint import save_checkpoint
    from crossloc3d_ros.encoder.model import CrossLoc3D

    torch.manual_seed(1)
    save_checkpoint(tmp_path / "other.safetensors", CrossLoc3D(SMALL_MODEL), PreprocessingConfig(), dtype="float32")
    other = Installation(tmp_path / "other.safetensors", installed.map, installed.bag)
    assert "other weights" in fails(capsys, other.arguments(tmp_path / "out"))


def test_of_a_damaged_bag_the_whole_part_is_kept(
    installed: Installation, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    damaged = tmp_path / "drive"
    shutil.copytree(installed.bag, damaged)
    (file,) = damaged.glob("*.db3")
    content = bytearray(file.read_bytes())
    at = int(len(content) * 0.7) // 4096 * 4096
    content[at : at + 64 * 4096] = np.random.default_rng(0).bytes(64 * 4096)
    file.write_bytes(content)
    victim = Installation(installed.weights, installed.map, damaged)
    line = fails(capsys, [*victim.arguments(tmp_path / "out"), "--every", "1"])
    assert file.name in line
    kept = rows_of(tmp_path / "out")
    assert len(kept) >= 3
    assert sum(row["error_m"] != "" for row in kept) >= 3
    assert "damaged" in (tmp_path / "out" / "index.html").read_text()


def test_old_results_do_not_outlive_a_failed_run(installed: Installation, tmp_path: Path) -> None:
    for name in ("estimates.csv", "estimates.geojson", "summary.json", "index.html"):
        (tmp_path / name).write_text("old")
    (tmp_path / "notes.txt").write_text("mine")
    with bag.BagWriter(tmp_path / "empty") as writer:
        writer.add_topic("/points", bag.POINT_CLOUD)
        writer.write("/gnss", bag.NAV_SAT_FIX, 1, messages.nav_sat_fix(1, "gnss", 52.0, 4.0, 0.0))
    victim = Installation(installed.weights, installed.map, tmp_path / "empty")
    assert replay.main(victim.arguments(tmp_path)) == 2
    assert not (tmp_path / "index.html").exists()
    assert not (tmp_path / "summary.json").exists()
    assert (tmp_path / "notes.txt").read_text() == "mine"


def test_ctrl_c_keeps_what_was_localized(installed: Installation, tmp_path: Path) -> None:
    with bag.open_bag(installed.bag) as reader, bag.BagWriter(tmp_path / "long") as writer:
        messages = list(reader.messages())
        for turn in range(40):
            for topic, t_ns, message in messages:
                kind = bag.NAV_SAT_FIX if topic == "/gnss" else bag.POINT_CLOUD
                writer.write(topic, kind, t_ns + turn * 60_000_000_000, message)
    victim = Installation(installed.weights, installed.map, tmp_path / "long")
    out = tmp_path / "out"
    process = subprocess.Popen(
        [sys.executable, "-m", "crossloc3d_ros.cli.replay", *victim.arguments(out), "--every", "1"],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )
    deadline = time.monotonic() + 240  # a busy machine compiles for minutes when the kernels are new
    while not (out / "estimates.csv").exists() or len((out / "estimates.csv").read_text().splitlines()) < 2:
        assert process.poll() is None
        assert time.monotonic() < deadline
        time.sleep(0.05)
    process.send_signal(signal.SIGINT)
    _, errors = process.communicate(timeout=120)
    assert process.returncode == 130, errors
    assert "Traceback" not in errors
    rows = rows_of(out)
    assert 1 <= len(rows) < 40 * 20
    assert all(row["latency_ms"] for row in rows)
    assert "interrupted" in (out / "index.html").read_text()


def test_the_odometry_is_found_or_named(tmp_path: Path) -> None:
    def chosen(names: list[str], topic: str | None = None, asked_for: bool = False, **settings: str) -> str | None:
        path = tmp_path / f"{len(list(tmp_path.iterdir()))}"
        with bag.BagWriter(path) as writer:
            writer.add_topic("/points", bag.POINT_CLOUD)
            for name in names:
                writer.add_topic(name, bag.ODOMETRY)
            writer.write("/gnss", bag.NAV_SAT_FIX, 1, messages.nav_sat_fix(1, "gnss", 52.0, 4.0, 0.0))
        with bag.open_bag(path) as reader:
            config = from_dict(LocalizerNodeConfig, settings)
            source = sources.choose_odometry(reader, topic, config, asked_for=asked_for)
        return None if source is None else source.topic or "scans"

    assert chosen([]) is None
    assert chosen(["/ground_truth/odom"]) is None
    assert chosen(["/wheels", "/ground_truth/odom"]) == "/wheels"
    assert chosen(["/wheels", "/odom"]) == "/odom"
    assert chosen(["/wheels", "/odom"], "/wheels") == "/wheels"
    assert chosen(["/odom"], odometry="none") is None
    assert chosen(["/odom"], odometry="scan") == "scans"
    assert chosen(["/ground_truth/odom"], "/ground_truth/odom") == "/ground_truth/odom"
    with pytest.raises(BagError, match=r"several odometry topics .*--odom-topic"):
        chosen(["/wheels", "/visual"])
    with pytest.raises(BagError, match="beside ground truth"):
        chosen(["/ground_truth/odom"], asked_for=True)


@pytest.mark.parametrize(
    "text",
    [
        "localizer:\n  ros__parameters:\n    top_k: 7\n    scan:\n      mounting: {z_m: 2.5, yaw_deg: 90}\n",
        "/**:\n  ros__parameters:\n    use_sim_time: true\n    top_k: 7\n    scan.mounting.z_m: 2.5\n"
        "    scan.mounting.yaw_deg: 90.0\n    qos_overrides: {/points: {subscription: {depth: 1}}}\n",
        "/**:\n  ros__parameters: {top_k: 3}\nother:\n  ros__parameters: {top_k: 9, unknown: 1}\n"
        "/localizer:\n  ros__parameters: {top_k: 7, scan: {mounting: {z_m: 2.5}, mounting.yaw_deg: 90}}\n",
    ],
    ids=["nested", "dotted", "several"],
)
def test_the_nodes_parameter_file_is_understood(tmp_path: Path, text: str) -> None:
    (tmp_path / "localizer.yaml").write_text(text)
    config = read_node_config(tmp_path / "localizer.yaml", {})
    assert (config.top_k, config.scan.mounting.z_m, config.scan.mounting.yaw_deg) == (7, 2.5, 90.0)
    on_top = read_node_config(tmp_path / "localizer.yaml", {"z_m": 0.8})
    assert (on_top.scan.mounting.z_m, on_top.scan.mounting.yaw_deg) == (0.8, 90.0)


def test_the_parameter_file_that_is_shipped_is_understood() -> None:
    shipped = Path(__file__).resolve().parents[2] / "config" / "localizer.yaml"
    assert read_node_config(shipped, {}).top_k >= 1


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("localizer:\n  ros__parameters: {tpo_k: 7}\n", "unknown setting 'tpo_k'"),
        ("localizer:\n  ros__parameters: {top_k: 0}\n", "'top_k' must lie between"),
        ("localizer:\n  top_k: 7\n", "'localizer' has no 'ros__parameters'"),
        ("- 1\n- 2\n", "holds no parameters"),
        ("localizer: [\n", "cannot read"),
    ],
)
def test_a_wrong_parameter_file_names_what_is_wrong(tmp_path: Path, text: str, message: str) -> None:
    (tmp_path / "p.yaml").write_text(text)
    with pytest.raises(ConfigError, match=message):
        read_node_config(tmp_path / "p.yaml", {})
    with pytest.raises(ConfigError, match="cannot read"):
        read_node_config(tmp_path / "nothing.yaml", {})


@pytest.mark.parametrize(
    "arguments", [["drive"], ["drive", "--map", "m", "--ros-args", "-r", "a:=b"]], ids=["no map", "remapping"]
)
def test_usage(arguments: list[str], capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as caught:
        replay.main(arguments)
    assert caught.value.code == 2
    assert "--publish" in capsys.readouterr().err


def test_publishing_refuses_in_one_line(
    installed: Installation, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    pytest.importorskip("rclpy")
    monkeypatch.setenv("ROS_DOMAIN_ID", str(1 + os.getpid() % 100))
    monkeypatch.setenv("ROS_AUTOMATIC_DISCOVERY_RANGE", "LOCALHOST")
    publish = [str(installed.bag), "--publish"]
    assert "'rate' must lie between" in fails(capsys, [*publish, "--rate", "0"])
    assert "its topics are: /gnss" in fails(capsys, [*publish, "--play-topics", "/points"])
    assert "no node subscribed to /velodyne_points" in fails(capsys, [*publish, "--wait-s", "0.2"])


def test_publishing_plays_everything(
    installed: Installation, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    pytest.importorskip("rclpy")
    monkeypatch.setenv("ROS_DOMAIN_ID", str(1 + os.getpid() % 100))
    monkeypatch.setenv("ROS_AUTOMATIC_DISCOVERY_RANGE", "LOCALHOST")
    arguments = [
        str(installed.bag),
        "--publish",
        "--wait-s",
        "0",
        "--rate",
        "20",
        "--clock",
        "--ros-args",
        "-r",
        "a:=b",
    ]
    assert replay.main(arguments) == 0
    with bag.open_bag(installed.bag) as reader:
        assert capsys.readouterr().out.startswith(f"{reader.message_count} messages in ")
