"""SIFT features of the photos, and which pairs of photos show the same things."""

from collections.abc import Hashable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from tempfile import TemporaryDirectory

import cv2
import numpy as np
import pycolmap

from querysplat_cli.runtime.errors import QuerySplatError
from querysplat_cli.runtime.progress import Progress
from querysplat_cli.scene.cameras import PhotoCamera, rescaled
from querysplat_cli.scene.views import Photo

FEATURE_SIZE = 1600
"""Longer side at which features are searched: more pixels cost time and find no better matches."""
THOROUGH_SIZE = 800
"""The same for the thorough search, which is slow and finds many features in few pixels."""
DEFAULT_FOCAL = 1.2
"""Focal length in units of the longer side where nothing is known (COLMAP's choice; 45° of view)."""
EXHAUSTIVE = 40
"""Up to this many photos every pair is matched."""
PARTNERS = 20
"""Beyond that, each photo is matched with the most similar ones, this many."""
SAMPLED_FEATURES = 256
"""Similarity is judged on each photo's largest features (preemptive matching, Wu 2013)."""

UNRELATED = {
    pycolmap.TwoViewGeometryConfiguration.UNDEFINED,
    pycolmap.TwoViewGeometryConfiguration.DEGENERATE,
    pycolmap.TwoViewGeometryConfiguration.WATERMARK,
}


@dataclass(frozen=True)
class Pair:
    """Photos `first` < `second` with the pixels [m, 2] that a common two-view geometry explains."""

    first: int
    second: int
    first_pixels: np.ndarray
    second_pixels: np.ndarray

    def __len__(self) -> int:
        return len(self.first_pixels)


@dataclass(frozen=True)
class Matches:
    """Verified matches of a set of photos.

    `sizes` are the (height, width) at which features were searched, `focals` the focal lengths there, from
    EXIF or None, `features` the number found; all by photo number. `folder` holds the same for COLMAP, whose
    image numbers are ours plus one. Pixels are of that size, centres at +0.5.
    """

    folder: Path
    sizes: tuple[tuple[int, int], ...]
    focals: tuple[float | None, ...]
    features: tuple[int, ...]
    pairs: tuple[Pair, ...]

    @property
    def database(self) -> Path:
        return self.folder / "matches.db"

    def focal(self, photo: int) -> float:
        """The focal length to start from, in pixels."""
        return self.focals[photo] or DEFAULT_FOCAL * max(self.sizes[photo])

    def partners(self, photo: int) -> list[int]:
        """The photos that have matches with this one."""
        return [pair.first + pair.second - photo for pair in self.pairs if photo in (pair.first, pair.second)]

    def largest_group(self) -> list[int]:
        """The largest group of photos that pairs connect, directly or through others."""
        group = list(range(len(self.sizes)))
        for pair in self.pairs:
            one, two = group[pair.first], group[pair.second]
            group = [one if member == two else member for member in group]
        largest = max(group, key=group.count)
        return [photo for photo, member in enumerate(group) if member == largest]


@contextmanager
def matched(
    photos: Sequence[Photo],
    *,
    seed: int,
    progress: Progress,
    thorough: bool = False,
    known: Sequence[PhotoCamera] | None = None,
) -> Iterator[Matches]:
    """Features and matches of the photos. What they need on disk is there only inside the `with`.

    `thorough` takes several times as long and relates photos that are wide apart. Photos of one size and
    EXIF focal length share one lens; `known` gives each its own instead.
    """
    # COLMAP reports to the terminal, on which standard output may be somebody's JSON.
    pycolmap.logging.minloglevel = pycolmap.logging.FATAL.value
    with TemporaryDirectory(prefix="querysplat-") as name, _naming_the_folder(name):
        folder = Path(name)
        progress("finding features", 0.0)
        sizes = _write_grey(photos, folder, THOROUGH_SIZE if thorough else FEATURE_SIZE)
        focals = tuple(
            photo.focal * size[1] / photo.width if photo.focal else None
            for photo, size in zip(photos, sizes, strict=True)
        )
        lenses = _known_lenses(known, sizes) if known else _shared_lenses(sizes, focals)
        matches = Matches(folder, sizes, focals, (), ())
        with pycolmap.Database.open(matches.database) as store:
            _write_images(store, lenses)
        _extract(matches.database, folder, thorough=thorough)
        with pycolmap.Database.open(matches.database) as store:
            keypoints = [store.read_keypoints(i + 1)[:, :2].astype(np.float64) for i in range(len(photos))]
            chosen = _choose_pairs(store, len(photos))
        progress("matching", 0.3)
        _match(matches.database, folder, chosen, seed, thorough=thorough)
        with pycolmap.Database.open(matches.database) as store:
            pairs = _verified_pairs(store, keypoints)
        yield replace(matches, features=tuple(map(len, keypoints)), pairs=pairs)


@contextmanager
def _naming_the_folder(folder: str) -> Iterator[None]:
    """COLMAP's database does not say which disk is full."""
    try:
        yield
    except RuntimeError as error:
        if "SQLite" not in str(error):
            raise
        raise QuerySplatError(
            f"cannot write to {folder}: {error}", "Free some space there, or set TMPDIR to another folder."
        ) from error


def _image_name(photo: int) -> str:
    return f"{photo:06d}.pgm"


def _write_grey(photos: Sequence[Photo], folder: Path, size: int) -> tuple[tuple[int, int], ...]:
    """Write the photos as grey pictures of a longer side of at most `size`, and return their sizes."""
    sizes = []
    for number, photo in enumerate(photos):
        scale = min(1.0, size / max(photo.height, photo.width))
        height, width = round(photo.height * scale), round(photo.width * scale)
        grey = cv2.cvtColor(photo.pixels, cv2.COLOR_RGB2GRAY)
        picture = cv2.resize(grey, (width, height), interpolation=cv2.INTER_AREA)
        if not cv2.imwrite(str(folder / _image_name(number)), picture):
            raise OSError(f"cannot write to {folder}")
        sizes.append((height, width))
    return tuple(sizes)


def _shared_lenses(
    sizes: Sequence[tuple[int, int]], focals: Sequence[float | None]
) -> list[tuple[Hashable, pycolmap.Camera]]:
    lenses: list[tuple[Hashable, pycolmap.Camera]] = []
    for (height, width), focal in zip(sizes, focals, strict=True):
        guess = focal or DEFAULT_FOCAL * max(height, width)
        camera = pycolmap.Camera.create_from_model_name(1, "SIMPLE_RADIAL", guess, width, height)
        camera.has_prior_focal_length = focal is not None
        lenses.append(((height, width, focal and round(focal / width, 2)), camera))
    return lenses


def _known_lenses(
    known: Sequence[PhotoCamera], sizes: Sequence[tuple[int, int]]
) -> list[tuple[Hashable, pycolmap.Camera]]:
    lenses: list[tuple[Hashable, pycolmap.Camera]] = []
    for photo, ((height, width), camera) in enumerate(zip(sizes, known, strict=True)):
        lens = rescaled(camera, height, width)
        params = (*lens.focal, *lens.principal, *lens.distortion)
        found = pycolmap.Camera(model="OPENCV", width=width, height=height, params=params, has_prior_focal_length=True)
        lenses.append((photo, found))
    return lenses


def _write_images(store: pycolmap.Database, lenses: Sequence[tuple[Hashable, pycolmap.Camera]]) -> None:
    """One image for each lens; those with the same key share it.

    Written before the features are searched, since that numbers images in the order in which threads finish.
    """
    numbers = dict[Hashable, int]()
    for photo, (key, camera) in enumerate(lenses):
        if key not in numbers:
            numbers[key] = camera.camera_id = len(numbers) + 1
            rig = pycolmap.Rig(rig_id=camera.camera_id)
            rig.add_ref_sensor(camera.sensor_id)
            store.write_camera(camera, use_camera_id=True)
            store.write_rig(rig, use_rig_id=True)
        image = pycolmap.Image(name=_image_name(photo), camera_id=numbers[key], image_id=photo + 1)
        frame = pycolmap.Frame(frame_id=photo + 1, rig_id=numbers[key])
        frame.add_data_id(image.data_id)
        store.write_frame(frame, use_frame_id=True)
        store.write_image(image, use_image_id=True)


def _extract(database: Path, folder: Path, *, thorough: bool) -> None:
    options = pycolmap.FeatureExtractionOptions()
    options.use_gpu = False
    if thorough:
        options.sift.estimate_affine_shape = True
        options.sift.domain_size_pooling = True
        options.sift.peak_threshold = 0.003
    pycolmap.extract_features(database, folder, extraction_options=options)


def _choose_pairs(store: pycolmap.Database, count: int) -> list[tuple[int, int]]:
    everything = [(i, j) for i in range(count) for j in range(i + 1, count)]
    if count <= EXHAUSTIVE:
        return everything
    similarity = _similarity([_largest_features(store, photo) for photo in range(count)])
    order = np.argsort(-similarity, axis=1, kind="stable")[:, :PARTNERS]
    near = {(min(i, j), max(i, j)) for i in range(count) for j in order[i].tolist() if i != j}
    return [(i, j) for i, j in everything if (i, j) in near or j - i <= 2]


def _largest_features(store: pycolmap.Database, photo: int) -> np.ndarray:
    """Unit descriptors [n, 128] of a photo's largest features."""
    keypoints = store.read_keypoints(photo + 1)
    scale = np.hypot(keypoints[:, 2], keypoints[:, 4]) if keypoints.shape[1] == 6 else keypoints[:, 2]
    largest = np.argsort(-scale, kind="stable")[:SAMPLED_FEATURES]
    descriptors = store.read_descriptors(photo + 1).data[largest].astype(np.float32)
    return np.asarray(descriptors / np.maximum(np.linalg.norm(descriptors, axis=1, keepdims=True), 1))


def _similarity(descriptors: Sequence[np.ndarray]) -> np.ndarray:
    """For each two photos, the features whose nearest feature in the other is clearly nearer than the second."""
    count = len(descriptors)
    everything = np.zeros((count, SAMPLED_FEATURES, descriptors[0].shape[1]), np.float32)
    for photo, rows in enumerate(descriptors):
        everything[photo, : len(rows)] = rows
    similarity = np.zeros((count, count), np.int64)
    for photo, rows in enumerate(descriptors):
        cosines = (rows @ everything.reshape(count * SAMPLED_FEATURES, -1).T).reshape(len(rows), count, -1)
        nearest = cosines.argmax(-1)[..., None]
        first = np.take_along_axis(cosines, nearest, -1)[..., 0]
        np.put_along_axis(cosines, nearest, -1, -1)
        # |a − b|² = 2 − 2·cos for unit vectors, so this is the usual ratio of distances, 0.8, squared.
        similarity[photo] = np.count_nonzero(1 - first < 0.64 * (1 - cosines.max(-1)), axis=0)
    np.fill_diagonal(similarity, 0)
    return similarity + similarity.T


def _match(database: Path, folder: Path, pairs: Sequence[tuple[int, int]], seed: int, *, thorough: bool) -> None:
    listing = folder / "pairs.txt"
    listing.write_text("".join(f"{_image_name(first)} {_image_name(second)}\n" for first, second in pairs))
    pairing = pycolmap.ImportedPairingOptions()
    pairing.match_list_path = listing
    # Ctrl-C is heard between blocks.
    pairing.block_size = 100
    matching = pycolmap.FeatureMatchingOptions()
    matching.use_gpu = False
    matching.guided_matching = thorough
    matching.sift.max_ratio = 0.9 if thorough else 0.8
    verification = pycolmap.TwoViewGeometryOptions()
    verification.ransac.random_seed = seed
    # Among many more candidates, more of them agree by chance.
    verification.min_num_inliers = 25 if thorough else 15
    pycolmap.match_image_pairs(
        database, matching_options=matching, pairing_options=pairing, verification_options=verification
    )


def _verified_pairs(store: pycolmap.Database, keypoints: Sequence[np.ndarray]) -> tuple[Pair, ...]:
    pairs = []
    for pair_id, geometry in zip(*store.read_two_view_geometries(), strict=True):
        matches = geometry.inlier_matches
        if geometry.config in UNRELATED or not len(matches):
            continue
        one, two = (number - 1 for number in pycolmap.pair_id_to_image_pair(pair_id))
        pixels = {one: keypoints[one][matches[:, 0]], two: keypoints[two][matches[:, 1]]}
        first, second = min(one, two), max(one, two)
        pairs.append(Pair(first, second, pixels[first], pixels[second]))
    return tuple(sorted(pairs, key=lambda pair: (pair.first, pair.second)))
