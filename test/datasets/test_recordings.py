"""Scans of a recording: where GNSS places them, which are left out and why, and along which heading."""

from __future__ import annotations

import math
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from crossloc3d_ros.config import DatasetConfig, PreprocessingConfig, ScanConfig
from crossloc3d_ros.datasets import recordings as recording
from crossloc3d_ros.datasets.recordings import (
    DOUBTFUL,
    NO_FIX,
    OUTAGE,
    OUTSIDE,
    TOO_NEAR,
    UNUSABLE,
    GnssTrack,
    RecordedScans,
    Topics,
    headings,
    read_scans,
    read_tracks,
)
from crossloc3d_ros.errors import BagError
from crossloc3d_ros.formats import bag as bags
from crossloc3d_ros.formats import messages
from crossloc3d_ros.formats.bag import open_bag
from crossloc3d_ros.geodesy import MapFrame

PATCH = PreprocessingConfig(half_extent_m=15.0, scan_half_extent_m=15.0, n_points=256, min_points=40)


def scans_of(area, number: int = 0, **settings: float) -> RecordedScans:  # type: ignore[no-untyped-def]
    """Return the scans of one drive, by default all of them."""
    config = DatasetConfig(**{"scan_spacing_m": 0.0, **settings})
    return read_scans(area.bags[number], Topics(), area.crs, ScanConfig(), PATCH, config)


def seconds(area, scans: RecordedScans) -> np.ndarray:  # type: ignore[no-untyped-def]
    """Return the scans' stamps in seconds."""
    return (scans.stamp_ns - area.start_ns) / 1e9


@pytest.fixture(scope="module")
def all_scans(recorded_area) -> tuple[RecordedScans, RecordedScans]:  # type: ignore[no-untyped-def]
    """Give every usable scan of both drives."""
    return scans_of(recorded_area, 0), scans_of(recorded_area, 1)


def test_scans_lie_where_they_were_taken_and_look_along_their_heading(recorded_area, all_scans) -> None:  # type: ignore[no-untyped-def]
    for truth, scans in zip(recorded_area.truth, all_scans, strict=True):
        rows = np.round(seconds(recorded_area, scans) * 2).astype(int) - 1
        np.testing.assert_allclose(scans.xy_m, truth[rows, :2], atol=0.01)
        error = np.angle(np.exp(1j * (scans.heading_rad - truth[rows, 2])))
        assert np.abs(error).max() < math.radians(4.0)
        assert scans.patches.shape == (len(scans), 256, 3)
        assert np.abs(scans.patches).max() <= 1.0


def test_what_gnss_does_not_place_is_left_out_and_counted(recorded_area, all_scans) -> None:  # type: ignore[no-untyped-def]
    scans = all_scans[0]
    at = seconds(recorded_area, scans)
    for low, high in ((40.0, 46.0), (60.2, 63.8), (80.0, 86.0)):
        assert not ((at > low) & (at < high)).any()
    # Fixes come at .2 and .7 s, scans at .0 and .5 s, so that a bad fix spoils the scans on both sides of it.
    assert scans.dropped[OUTSIDE] == 4
    assert scans.dropped[NO_FIX] == 13
    assert scans.dropped[DOUBTFUL] == 9
    assert scans.dropped[OUTAGE] == 13
    assert scans.seen == len(scans) + sum(scans.dropped.values()) == 220


def test_a_covariance_of_just_the_limit_is_good_enough(recorded_area) -> None:  # type: ignore[no-untyped-def]
    with open_bag(recorded_area.bags[0]) as bag:
        track, _, _ = read_tracks(bag, "/gnss", None, MapFrame(recorded_area.crs, np.zeros(3)))
    stamps = recorded_area.start_ns + (recorded_area.truth[0][:, 3] * 1e9).astype(np.int64)
    for limit_m, doubtful in ((10.0, 9), (12.0, 0), (11.99, 9)):
        _, reasons = track.locate(stamps, DatasetConfig(max_gnss_std_m=limit_m))
        assert reasons.count(DOUBTFUL) == doubtful


def test_scans_keep_their_distance(recorded_area) -> None:  # type: ignore[no-untyped-def]
    scans = scans_of(recorded_area, scan_spacing_m=7.0)
    steps = np.hypot(*np.diff(scans.xy_m, axis=0).T)
    assert steps.min() >= 7.0
    assert np.median(steps) == pytest.approx(8.0, abs=0.1)
    assert scans.dropped[TOO_NEAR] > 90


STAMPS = st.lists(st.integers(0, 60_000), min_size=1, max_size=30, unique=True).map(sorted)


@given(STAMPS, st.integers(-5_000, 65_000), st.randoms(use_true_random=False))
def test_positions_are_interpolated_between_two_good_fixes_and_never_beyond(stamps, asked, random) -> None:  # type: ignore[no-untyped-def]
    milliseconds = np.array(stamps, np.int64)
    std_m = np.array([random.choice([0.5, 0.5, 0.5, 20.0, math.nan]) for _ in stamps])
    xy_m = np.column_stack([milliseconds * 0.004, -milliseconds * 0.001])
    xy_m[np.isnan(std_m)] = np.nan
    track = GnssTrack(milliseconds * 1_000_000, xy_m, std_m)
    place, (reason,) = track.locate(asked * 1_000_000, DatasetConfig())
    assert np.isnan(place).any() == bool(reason)
    if not reason:
        np.testing.assert_allclose(place[0], [asked * 0.004, -asked * 0.001], atol=1e-6)
        before, after = milliseconds[milliseconds <= asked].max(), milliseconds[milliseconds >= asked].min()
        assert after - before <= 2_500
        assert (std_m[np.isin(milliseconds, [before, after])] <= 10.0).all()
    if asked < stamps[0] or asked > stamps[-1]:
        assert reason == OUTSIDE


def test_without_odometry_the_course_is_the_heading_and_standing_has_none(recorded_area) -> None:  # type: ignore[no-untyped-def]
    config = DatasetConfig()
    with open_bag(recorded_area.bags[1]) as bag:
        track, odometry, damage = read_tracks(bag, "/gnss", None, MapFrame(recorded_area.crs, np.zeros(3)))
    assert odometry is None
    assert damage == ""
    inside = track.stamp_ns[10:-10]
    np.testing.assert_allclose(np.abs(headings(inside, track, None, config)), math.pi, atol=0.01)
    standing = GnssTrack(track.stamp_ns, np.zeros_like(track.xy_m), track.std_m)
    assert np.isnan(headings(inside, standing, None, config)).all()


def test_driving_backwards_does_not_turn_the_heading(recorded_area) -> None:  # type: ignore[no-untyped-def]
    with open_bag(recorded_area.bags[0]) as bag:
        track, odometry, _ = read_tracks(bag, "/gnss", "/odom", MapFrame(recorded_area.crs, np.zeros(3)))
    assert odometry is not None
    backwards = recording.OdometryTrack(odometry.stamp_ns, odometry.xy_m, odometry.yaw_rad + math.pi)
    found = headings(track.stamp_ns[20:60], track, backwards, DatasetConfig())
    assert np.abs(np.angle(np.exp(1j * (found - math.pi)))).max() < math.radians(4.0)


@pytest.fixture
def recorded(tmp_path: Path) -> Callable[..., Path]:
    """Give the writer of a recording with chosen topics."""

    def write(*topics: str) -> Path:
        path = tmp_path / "some"
        with bags.BagWriter(path) as writer:
            for topic in topics:
                if "gnss" in topic:
                    writer.write(topic, bags.NAV_SAT_FIX, 5, messages.nav_sat_fix(5, "gnss", 52.0, 5.0, 0.0))
                elif "imu" in topic:
                    writer.write(topic, bags.IMU, 5, messages.imu(5, "imu", (0, 0, 0), (0, 0, 9.8)))
                else:
                    cloud = messages.velodyne_cloud(5, "velodyne", np.zeros((10, 3)), 0, 0, 0)
                    writer.write(topic, bags.POINT_CLOUD, 5, cloud)
        return path

    return write


def read(path: Path, topics: Topics | None = None) -> RecordedScans:
    """Read a recording with the defaults."""
    return read_scans(path, topics or Topics(), "EPSG:32631", ScanConfig(), PATCH, DatasetConfig())


@pytest.mark.parametrize(
    ("topics", "message"),
    [
        (("/points", "/imu"), r"no topic of type sensor_msgs/msg/NavSatFix.*/imu.*needs GNSS"),
        (("/gnss",), "no topic of type sensor_msgs/msg/PointCloud2"),
        (("/points", "/gnss/a", "/gnss/b"), r"several GNSS topics \(/gnss/a, /gnss/b\)"),
        (("/front", "/rear", "/gnss"), r"several topics of type .*PointCloud2 \(/front, /rear\)"),
    ],
)
def test_what_a_recording_lacks_is_said(recorded, topics: tuple[str, ...], message: str) -> None:  # type: ignore[no-untyped-def]
    with pytest.raises(BagError, match=message):
        read(recorded(*topics))


def test_topics_that_are_named_must_be_there(recorded) -> None:  # type: ignore[no-untyped-def]
    path = recorded("/points", "/gnss")
    for topics in (Topics(imu="/imu"), Topics(odometry="/odom"), Topics(gnss="/fix"), Topics(points="/cloud")):
        with pytest.raises(BagError, match="has no topic"):
            read(path, topics)


def test_a_scan_without_enough_points_is_counted(recorded) -> None:  # type: ignore[no-untyped-def]
    scans = read(recorded("/points", "/gnss"))
    assert len(scans) == 0
    assert dict(scans.dropped) == {UNUSABLE: 1}


@pytest.mark.parametrize("name", ["einride_vlp16_pointcloud2_mcap", "nebula_vlp16_pointcloud2_mcap"])
def test_real_recordings_without_gnss_are_refused_saying_so(shared, name: str) -> None:  # type: ignore[no-untyped-def]
    with pytest.raises(BagError, match=r"NavSatFix.*velodyne_points.*a dataset needs GNSS"):
        read(shared(f"data/vlp16/{name}"))


def test_the_part_before_a_recordings_damage_is_used(recorded_area, all_scans, tmp_path: Path) -> None:  # type: ignore[no-untyped-def]
    (file,) = recorded_area.bags[0].glob("*.mcap")
    cut = tmp_path / file.name
    data = bytearray(file.read_bytes())
    middle = len(data) // 2
    data[middle : middle + 200_000] = bytes(200_000)
    cut.write_bytes(data)
    scans = read_scans(cut, Topics(), recorded_area.crs, ScanConfig(), PATCH, DatasetConfig(scan_spacing_m=0.0))
    assert "cannot read" in scans.damage
    assert 0 < len(scans) < len(all_scans[0])
