"""From a map to its calibration: everything is there, belongs together, and is used by the localizer."""

from __future__ import annotations

import dataclasses
import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import rasterio

from crossloc3d_ros.aerial_map import store
from crossloc3d_ros.aerial_map.calibration import CALIBRATION
from crossloc3d_ros.aerial_map.store import AerialMap
from crossloc3d_ros.clouds.raster import Raster
from crossloc3d_ros.config import LocalizabilityConfig, LocalizerConfig
from crossloc3d_ros.errors import ConfigError, MapError
from crossloc3d_ros.localizability.calibrate import calibrate_map
from crossloc3d_ros.localizability.page import PAGE, limit_words
from crossloc3d_ros.localizability.raster import CELL_M, NEVER, RASTER, distance_class
from crossloc3d_ros.localizability.squares import SIDE_M, choose_squares, divided
from crossloc3d_ros.localization.localizer import Localizer


def test_what_was_found_is_what_lies_in_the_folder(calibrated: Any) -> None:
    aerial_map = AerialMap.load(calibrated.folder, calibrated.encoder.fingerprint)
    assert aerial_map.calibration == calibrated.found.calibration and aerial_map.calibration_fault == ""
    counts = calibrated.found.calibration.counts
    assert counts.places == 4 == counts.at_once + counts.after_20_m + counts.after_100_m + counts.never
    assert counts.off_map == 7
    assert calibrated.found.calibration.off_map_belief <= 0.99 + 1e-9
    assert calibrated.stages == ("scanning", "off the map", "driving")


def test_scans_of_the_map_s_own_world_are_found_on_it(calibrated: Any) -> None:
    """The world, its poses and the raster's grid agree: a shift of some metres would leave none right."""
    assert calibrated.found.calibration.counts.right >= 2


def test_the_localizer_uses_the_offset(calibrated: Any) -> None:
    aerial_map = AerialMap.load(calibrated.folder, calibrated.encoder.fingerprint)
    localizer = Localizer(aerial_map, calibrated.encoder, LocalizerConfig(), threads=1)
    assert localizer.calibration_words.startswith("calibrated for a vlp-16 at 1.2 m: ")


def test_the_raster_lies_where_the_drives_were(calibrated: Any) -> None:
    """Read by a GIS's own library, at the places themselves."""
    aerial_map = AerialMap.load(calibrated.folder)
    with rasterio.open(calibrated.folder / RASTER) as file:
        assert file.crs.to_string() == aerial_map.manifest.crs
        assert file.count == 2 and file.res == (CELL_M, CELL_M) and np.isnan(file.nodata)
        distance, probability = file.read(1), file.read(2)
        row, column = np.nonzero(np.isfinite(distance))
        easting, northing = rasterio.transform.xy(file.transform, row, column)
    places = np.array([(place.easting, place.northing) for place in calibrated.found.places])
    middles = np.column_stack([easting, northing])
    away = np.hypot(*(middles[:, None] - places[None]).transpose(2, 0, 1))
    assert len(middles) >= len(places) and (away.min(axis=1) <= 25.0).all()
    assert (away.min(axis=0) <= CELL_M).all(), "a place on open ground has a cell around it or beside it"
    classes = np.array([distance_class(place) for place in calibrated.found.places])
    np.testing.assert_array_equal(distance[row, column], classes[away.argmin(axis=1)])
    assert set(np.unique(distance[row, column])) <= {0.0, 20.0, 100.0, NEVER}
    np.testing.assert_array_equal(np.isfinite(probability), np.isfinite(distance))
    assert ((probability[row, column] >= 0.0) & (probability[row, column] <= 1.0)).all()


def test_the_page_needs_nothing_else_and_says_what_was_done(calibrated: Any) -> None:
    page = (calibrated.folder / PAGE).read_text()
    assert "http://" not in page.replace("http://www.w3.org", "") and "https://" not in page
    assert "src=" not in page.replace('src="data:', "")
    for words in ("at once", "within 20 m", "within 100 m", "not within 100 m", "Twin streets", "N ↑", "vlp-16"):
        assert words in page
    assert page.count("<title>") == 1 + len(calibrated.found.places)


@pytest.mark.parametrize(
    ("offset", "unlimited", "words"),
    [
        (0.0, 2.4, "+2.40 ± 0.50, would raise the belief"),
        (-3.0, -1.0, "-1.00 ± 0.50, is lowered to -3.00"),
        (-1.0, -1.0, "the most probable one, -1.00 ± 0.50"),
    ],
)
def test_the_page_says_what_limits_the_offset(calibrated: Any, offset: float, unlimited: float, words: str) -> None:
    made = calibrated.found.calibration
    assert words in limit_words(dataclasses.replace(made, offset=offset, unlimited_offset=unlimited, offset_std=0.5))


def test_a_calibration_of_a_map_that_was_built_again_is_left_aside(calibrated: Any, tmp_path: Path) -> None:
    shutil.copytree(calibrated.folder, tmp_path / "map")
    manifest = store.read_manifest(tmp_path / "map")
    store.write_manifest(tmp_path / "map", dataclasses.replace(manifest, created="another day"))
    aerial_map = AerialMap.load(tmp_path / "map")
    assert aerial_map.calibration is None
    assert "before it was built again" in aerial_map.calibration_fault
    (tmp_path / "map" / CALIBRATION).unlink()
    assert AerialMap.load(tmp_path / "map").calibration_fault == ""


def test_an_unknown_lidar_is_refused_before_anything_is_done(calibrated: Any) -> None:
    with pytest.raises(ConfigError, match=r"unknown lidar 'vlp-17'; known are: .*vlp-16"):
        calibrate_map(calibrated.folder, calibrated.encoder, LocalizabilityConfig(lidar="vlp-17"))


def test_a_map_without_open_ground_is_refused(town_map: AerialMap, monkeypatch: pytest.MonkeyPatch) -> None:
    def wood(self: AerialMap, bounds: Any = None) -> Raster:
        ground = self.terrain(bounds)
        return dataclasses.replace(ground, values=ground.values + np.float32(5.0))

    monkeypatch.setattr(AerialMap, "surface", wood)
    with pytest.raises(MapError, match="has no open ground to drive on"):
        choose_squares(town_map, 10, 0)


def test_squares_lie_on_the_map_and_share_its_places(town_map: AerialMap) -> None:
    west, south, east, north = town_map.bounds
    for square in divided(town_map):
        assert west <= square.min_x < square.max_x <= east + 1 and south <= square.min_y < square.max_y <= north + 1
        assert square.max_x - square.min_x <= SIDE_M and (square.max_x - square.min_x) % 2 == 0
    assert sum(square.places for square in choose_squares(town_map, 10, 0)) == 10
