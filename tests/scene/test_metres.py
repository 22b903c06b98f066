"""The size of a scene from GPS in EXIF, and from known distances."""

from pathlib import Path

import numpy as np
import pytest
from PIL import ExifTags, Image
from scipy.spatial.transform import Rotation

from querysplat_cli.runtime.errors import QuerySplatError
from querysplat_cli.scene.exif import Gps
from querysplat_cli.scene.metres import local_metres, metres_by_distances, metres_by_gps
from querysplat_cli.scene.photos import load_photos

METRES_PER_UNIT = 7.5


def walk(count: int = 20, *, noise: float = 0.0, heights: bool = True) -> tuple[dict[str, np.ndarray], dict[str, Gps]]:
    """Camera centres in scene units, and where GPS says that they are: a walk of about 60 m at 48° north."""
    chance = np.random.default_rng(0)
    true = np.cumsum(chance.normal(0, 2, (count, 3)) * [1, 1, 0.1] + [3, 1, 0], 0)
    turn = Rotation.random(random_state=1).as_matrix()
    centres = true @ turn.T / METRES_PER_UNIT + [5.0, -2.0, 1.0]
    seen = true + chance.normal(0, noise, true.shape)
    north, east = 111_208.0, 74_628.0  # metres for a degree at 48° (WGS 84)
    names = [f"{i}.jpg" for i in range(count)]
    places = [Gps(48 + y / north, 11 + x / east, 500 + z if heights else None) for x, y, z in seen]
    return dict(zip(names, centres, strict=True)), dict(zip(names, places, strict=True))


def test_degrees_become_metres() -> None:
    east, north, up = local_metres([Gps(48.0, 11.0, 3.0), Gps(48.001, 11.0, 5.0), Gps(48.0, 11.001, 3.0)]).T
    assert north[1] - north[0] == pytest.approx(111.2, abs=0.05)
    assert east[2] - east[0] == pytest.approx(74.63, abs=0.05)
    assert up[1] - up[0] == 2
    far = local_metres([Gps(0.0, 179.999), Gps(0.0, -179.999)])
    assert np.linalg.norm(far[1] - far[0]) == pytest.approx(222.6, abs=0.1)


@pytest.mark.parametrize("heights", [True, False])
def test_the_scale_of_exact_places(heights: bool) -> None:
    found = metres_by_gps(*walk(heights=heights))
    assert found.per_unit == pytest.approx(METRES_PER_UNIT, rel=1e-3 if heights else 0.02)
    assert found.count == 20
    assert found.residual is not None
    assert found.residual < (0.02 if heights else 1.0)


def test_noise_and_outliers() -> None:
    centres, places = walk(40, noise=2.0)
    for name in ("3.jpg", "17.jpg", "30.jpg"):
        places[name] = Gps(places[name].latitude + 0.01, places[name].longitude, 500.0)  # a kilometre off
    found = metres_by_gps(centres, places)
    assert found.per_unit == pytest.approx(METRES_PER_UNIT, rel=0.05)
    assert found.residual is not None
    assert 1 < found.residual < 6


def test_places_that_say_nothing_are_refused() -> None:
    centres, places = walk()
    with pytest.raises(QuerySplatError, match="3 of the 20 photos"):
        metres_by_gps(centres, {name: places[name] for name in list(places)[:3]})
    chance = np.random.default_rng(0)
    table = {name: 0.05 * centre for name, centre in centres.items()}
    noise = {name: Gps(48 + 3e-5 * chance.normal(), 11 + 4e-5 * chance.normal(), 500.0) for name in centres}
    with pytest.raises(QuerySplatError, match="GPS is off by"):
        metres_by_gps(table, noise)


def test_known_distances() -> None:
    centres = {"a": np.zeros(3), "b": np.array([2.0, 0, 0]), "c": np.array([0, 4.0, 0])}
    one = metres_by_distances(centres, [("a", "b", 3.0)])
    assert (one.per_unit, one.residual) == (1.5, None)
    two = metres_by_distances(centres, [("a", "b", 3.0), ("a", "c", 6.4)])
    assert two.per_unit == pytest.approx(1.55)
    assert two.residual == pytest.approx(0.15, abs=0.06)
    with pytest.raises(QuerySplatError, match="none of the photos used"):
        metres_by_distances(centres, [("a", "x", 3.0)])
    with pytest.raises(QuerySplatError, match="one place"):
        metres_by_distances(centres, [("a", "a", 3.0)])


def test_gps_is_read_from_exif(tmp_path: Path) -> None:
    data = Image.Exif()
    data[ExifTags.IFD.GPSInfo] = {
        ExifTags.GPS.GPSLatitudeRef: "S",
        ExifTags.GPS.GPSLatitude: (33.0, 51.0, 24.6),
        ExifTags.GPS.GPSLongitudeRef: "E",
        ExifTags.GPS.GPSLongitude: (151.0, 12.0, 54.0),
        ExifTags.GPS.GPSAltitudeRef: b"\x00",
        ExifTags.GPS.GPSAltitude: 12.5,
    }
    Image.new("RGB", (80, 80)).save(tmp_path / "a.jpg", exif=data)
    Image.new("RGB", (80, 80)).save(tmp_path / "b.jpg")
    (first, second), _ = load_photos([tmp_path / "a.jpg", tmp_path / "b.jpg"])
    assert first.gps is not None
    assert first.gps.latitude == pytest.approx(-33.8568333)
    assert first.gps.longitude == pytest.approx(151.215)
    assert first.gps.height == 12.5
    assert second.gps is None
