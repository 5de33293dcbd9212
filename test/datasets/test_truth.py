"""The GNSS track of a bag as truth."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from crossloc3d_ros.datasets.truth import TruthTrack, find_heading_topic, find_truth_topic, read_heading, read_truth
from crossloc3d_ros.errors import BagError
from crossloc3d_ros.formats import bag, messages
from crossloc3d_ros.geodesy import MapFrame

FRAME = MapFrame("EPSG:32631", np.array([628_700.0, 5_803_600.0, 2.0]), 43.0)
SECOND = 1_000_000_000
START = 1_700_000_000 * SECOND


def track(seconds: list[float], eastings: list[float]) -> TruthTrack:
    stamps = np.array([START + round(s * SECOND) for s in seconds], dtype=np.int64)
    grid = np.column_stack([eastings, np.full(len(eastings), 5_803_600.0), np.zeros(len(eastings))])
    return TruthTrack("/gnss", stamps, grid, 0)


def at(truth: TruthTrack, *seconds: float) -> np.ndarray:
    return truth.at(np.array([START + round(s * SECOND) for s in seconds], dtype=np.int64))[:, 0]


def test_positions_between_fixes_are_interpolated_at_the_stamp() -> None:
    truth = track([0, 1, 2], [0.0, 10.0, 30.0])
    np.testing.assert_allclose(at(truth, 0.0, 0.25, 1.0, 1.5, 2.0), [0.0, 2.5, 10.0, 20.0, 30.0], atol=1e-6)


def test_nothing_is_made_up_outside_the_track_or_in_a_gap() -> None:
    truth = track([0, 1, 60, 61], [0.0, 10.0, 0.0, 10.0])
    values = at(truth, -0.001, 1.0, 1.001, 30.0, 59.999, 60.5, 61.001)
    np.testing.assert_allclose(values, [np.nan, 10.0, np.nan, np.nan, np.nan, 5.0, np.nan], atol=1e-6)
    assert np.isnan(track([], []).at(np.array([START]))).all()
    np.testing.assert_allclose(at(track([5], [7.0]), 4.9, 5.0, 5.1), [np.nan, 7.0, np.nan])


def write_gnss(path: Path, fixes: list[tuple[float, object]], topic: str = "/gnss") -> Path:
    with bag.BagWriter(path) as writer:
        for seconds, fix in fixes:
            writer.write(topic, bag.NAV_SAT_FIX, START + round(seconds * SECOND), fix)
    return path


def fix_at(seconds: float, easting: float, std_m: float | None = 1.0, **options: object) -> object:
    latitude, longitude, altitude = FRAME.to_geographic(np.array([[easting, 5_803_600.0, 3.0]]))
    covariance = None if std_m is None else np.eye(3) * std_m**2
    stamp_ns = START + round(seconds * SECOND)
    return messages.nav_sat_fix(
        stamp_ns, "gnss", float(latitude[0]), float(longitude[0]), float(altitude[0]), covariance, **options
    )


def test_a_track_comes_back_on_the_grid_and_doubtful_fixes_are_left_out(tmp_path: Path) -> None:
    broken, null_island = fix_at(4, 628_740.0), fix_at(6, 628_760.0, std_m=None)
    broken.latitude = float("nan")
    null_island.latitude = null_island.longitude = 0.0  # with STATUS_FIX, as drivers send it that have none yet
    fixes = [
        (0, fix_at(0, 628_700.0)),
        (1, fix_at(1, 628_710.0, std_m=9.9)),
        (2, fix_at(2, 629_900.0, std_m=10.1)),
        (3, fix_at(3, 629_900.0, has_fix=False)),
        (4, broken),
        (5, fix_at(5, 628_750.0, std_m=None)),
        (6, null_island),
    ]
    with bag.open_bag(write_gnss(tmp_path / "drive", fixes)) as reader:
        truth = read_truth(reader, "/gnss", FRAME)
    np.testing.assert_allclose(truth.grid[:, 0], [628_700.0, 628_710.0, 628_750.0], atol=1e-3)
    np.testing.assert_allclose(truth.grid[:, 2], 3.0, atol=1e-3)
    assert (len(truth), truth.dropped) == (3, 4)


def test_fixes_out_of_order_and_repeated_are_put_in_order(tmp_path: Path) -> None:
    fixes = [(0, fix_at(2, 628_720.0)), (1, fix_at(0, 628_700.0)), (2, fix_at(2, 628_720.0)), (3, fix_at(1, 628_710.0))]
    with bag.open_bag(write_gnss(tmp_path / "drive", fixes)) as reader:
        truth = read_truth(reader, "/gnss", FRAME)
    assert np.diff(truth.stamp_ns).tolist() == [SECOND, SECOND]
    np.testing.assert_allclose(at(truth, 0.5, 1.5), [628_705.0, 628_715.0], atol=1e-3)


def test_which_topic_is_the_truth(tmp_path: Path) -> None:
    def bag_with(name: str, *topics: str) -> Path:
        with bag.BagWriter(tmp_path / name) as writer:
            writer.write(
                "/odom", bag.ODOMETRY, START, messages.odometry(START, "odom", "base", [0, 0, 0], [0, 0, 0, 1])
            )
            for topic in topics:
                writer.write(topic, bag.NAV_SAT_FIX, START, fix_at(0, 628_700.0))
        return tmp_path / name

    with bag.open_bag(bag_with("none")) as reader:
        assert find_truth_topic(reader, None) is None
        with pytest.raises(BagError, match=r"no topic '/gnss'; its topics are: /odom"):
            find_truth_topic(reader, "/gnss")
        with pytest.raises(BagError, match=r"'/odom' .* holds nav_msgs/msg/Odometry"):
            find_truth_topic(reader, "/odom")
    with bag.open_bag(bag_with("one", "/gnss")) as reader:
        assert find_truth_topic(reader, None) == "/gnss"
    with bag.open_bag(bag_with("truth", "/gnss", "/ground_truth/fix")) as reader:
        assert find_truth_topic(reader, None) == "/ground_truth/fix"
        assert find_truth_topic(reader, "/gnss") == "/gnss"
    with (
        bag.open_bag(bag_with("two", "/gnss/left", "/gnss/right")) as reader,
        pytest.raises(BagError, match=r"/gnss/left, /gnss/right\); choose one with --gnss-topic"),
    ):
        find_truth_topic(reader, None)


def test_of_a_recording_that_breaks_off_the_whole_part_counts(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    path = write_gnss(tmp_path / "drive", [(i, fix_at(i, 628_700.0 + 10 * i)) for i in range(6)])
    with bag.open_bag(path) as reader:
        whole = list(reader.messages())

        def broken(count: int):
            yield from whole[:count]
            raise BagError("cannot read drive.db3")

        monkeypatch.setattr(reader, "messages", lambda topics: broken(3))
        assert len(read_truth(reader, "/gnss", FRAME)) == 3
        assert "the truth ends early" in caplog.text
        monkeypatch.setattr(reader, "messages", lambda topics: broken(0))
        with pytest.raises(BagError, match=r"drive\.db3"):
            read_truth(reader, "/gnss", FRAME)


def test_nothing_is_made_up_where_the_robot_was_carried() -> None:
    truth = track([0, 1, 1.2, 2.2], [0.0, 10.0, 500.0, 510.0])
    np.testing.assert_allclose(at(truth, 0.5, 1.1, 1.2, 1.7), [5.0, np.nan, 500.0, 505.0])


def write_truth(path: Path, headings: list[float], turned_rad: float = 0.0) -> Path:
    """Write a drive along an arc of 200 m and more, with its headings, in a frame turned by some angle."""
    with bag.BagWriter(path) as writer:
        place = np.array([628_700.0, 5_803_600.0, 2.0])
        convergence = float(FRAME.convergence_rad(place[None])[0])
        for i, heading in enumerate(headings):
            stamp = START + i * SECOND
            latitude, longitude, _ = FRAME.to_geographic(place[None])
            fix = messages.nav_sat_fix(stamp, "gnss", float(latitude[0]), float(longitude[0]), float("nan"), np.eye(3))
            writer.write("/ground_truth/fix", bag.NAV_SAT_FIX, stamp, fix)
            x, y, _ = FRAME.to_enu(place[None])[0]
            turn = np.exp(1j * turned_rad)
            told = turn * complex(x, y)
            yaw = heading + turned_rad
            message = messages.odometry(
                stamp, "world", "base_link", (told.real, told.imag, 0.0), (0, 0, np.sin(yaw / 2), np.cos(yaw / 2))
            )
            writer.write("/ground_truth/odom", bag.ODOMETRY, stamp, message)
            way = heading + convergence  # from grid east
            place = place + 10.0 * np.array([np.cos(way), np.sin(way), 0.0])
    return path


def test_true_headings_are_found_and_cross_the_seam(tmp_path: Path) -> None:
    headings = list(np.linspace(2.2, 4.2, 30))
    with bag.open_bag(write_truth(tmp_path / "drive", headings)) as reader:
        truth = read_truth(reader, "/ground_truth/fix", FRAME)
        topic = find_heading_topic(reader)
        assert topic == "/ground_truth/odom"
        track = read_heading(reader, topic, truth, FRAME)
    assert track is not None
    assert truth.std_m == 1.0
    between = START + np.array([-1, 0, 500_000_000, 14 * SECOND + 250_000_000, 29 * SECOND, 29 * SECOND + 1])
    expected = np.interp([0, 0, 0.5, 14.25, 29, 29], np.arange(30), headings)
    off = np.angle(np.exp(1j * (track.at(between) - expected)))
    np.testing.assert_allclose(off, [np.nan, 0, 0, 0, 0, np.nan], atol=1e-9)


@pytest.mark.parametrize("turned_deg", [-90.0, 5.0])
def test_headings_from_a_frame_of_their_own_are_left_out(
    tmp_path: Path, turned_deg: float, caplog: pytest.LogCaptureFixture
) -> None:
    path = write_truth(tmp_path / "drive", list(np.linspace(0.0, 1.0, 30)), np.radians(turned_deg))
    with bag.open_bag(path) as reader:
        truth = read_truth(reader, "/ground_truth/fix", FRAME)
        assert read_heading(reader, "/ground_truth/odom", truth, FRAME) is None
    assert f"turned by {turned_deg:.1f} degrees" in caplog.text


def test_an_orientation_that_was_never_filled_in_is_no_heading(tmp_path: Path) -> None:
    with bag.BagWriter(tmp_path / "drive") as writer:
        for i, quaternion in enumerate([(0, 0, 0, 0), (0, 0, 0, float("nan")), (0, 0, 1, 0)]):
            stamp = START + i
            message = messages.odometry(stamp, "world", "base_link", (0, 0, 0), quaternion)
            writer.write("/ground_truth/odom", bag.ODOMETRY, stamp, message)
    with bag.open_bag(tmp_path / "drive") as reader:
        headings = read_heading(reader, "/ground_truth/odom", track([], []), FRAME)
    assert headings is not None
    assert headings.stamp_ns.tolist() == [START + 2]
    assert abs(headings.heading_rad[0]) == pytest.approx(np.pi)
