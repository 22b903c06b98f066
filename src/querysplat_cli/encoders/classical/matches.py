"""SIFT features of the photos, and which pairs of photos show the same things."""

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory

import cv2
import numpy as np
import pycolmap

from querysplat_cli.progress import Progress
from querysplat_cli.scene.views import Photo

FEATURE_SIZE = 1600
"""Longer side at which features are searched: more pixels cost time and find no better matches."""
DEFAULT_FOCAL = 1.2
"""Focal length in units of the longer side where nothing is known (COLMAP's choice; 45° of view)."""
EXHAUSTIVE = 60
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
    EXIF or None, `features` the number found; all by photo number. The database holds the same for COLMAP,
    with `images` its names of the photos. Pixels are of that size, centres at +0.5.
    """

    folder: Path
    images: tuple[str, ...]
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


@contextmanager
def matched(photos: Sequence[Photo], *, seed: int, progress: Progress) -> Iterator[Matches]:
    """Features and matches of the photos. What they need on disk is there only inside the `with`.

    Photos of one size and EXIF focal length share one lens; the first lens found is COLMAP's camera 1.
    """
    # COLMAP reports to the terminal, on which standard output may be somebody's JSON.
    pycolmap.logging.minloglevel = pycolmap.logging.FATAL.value
    with TemporaryDirectory(prefix="querysplat-") as name:
        folder = Path(name)
        progress("finding features", 0.0)
        sizes, focals, images = _write_grey(photos, folder)
        database = folder / "matches.db"
        options = pycolmap.FeatureExtractionOptions()
        options.use_gpu = False
        pycolmap.extract_features(
            database, folder, camera_mode=pycolmap.CameraMode.PER_FOLDER, extraction_options=options
        )
        with pycolmap.Database.open(database) as store:
            numbers = {images.index(image.name): image.image_id for image in store.read_all_images()}
            keypoints = [store.read_keypoints(numbers[i])[:, :2].astype(np.float64) for i in range(len(photos))]
            _write_focals(store, numbers, focals)
            chosen = _choose_pairs(store, [numbers[i] for i in range(len(photos))])
        progress("matching", 0.3)
        _match(database, folder, [(images[i], images[j]) for i, j in chosen], seed)
        with pycolmap.Database.open(database) as store:
            pairs = _verified_pairs(store, {number: i for i, number in numbers.items()}, keypoints)
        yield Matches(folder, images, sizes, focals, tuple(map(len, keypoints)), pairs)


def _write_grey(
    photos: Sequence[Photo], folder: Path
) -> tuple[tuple[tuple[int, int], ...], tuple[float | None, ...], tuple[str, ...]]:
    """Write the photos as grey pictures, a folder for each lens: their sizes, focal lengths and names."""
    sizes, focals, images, lenses = [], [], [], dict[tuple[int, int, float | None], str]()
    for number, photo in enumerate(photos):
        scale = min(1.0, FEATURE_SIZE / max(photo.height, photo.width))
        height, width = round(photo.height * scale), round(photo.width * scale)
        focal = photo.focal * width / photo.width if photo.focal else None
        lens = lenses.setdefault((height, width, focal and round(focal / width, 2)), str(len(lenses)))
        grey = cv2.cvtColor(photo.pixels, cv2.COLOR_RGB2GRAY)
        (folder / lens).mkdir(exist_ok=True)
        images.append(f"{lens}/{number:06d}.pgm")
        cv2.imwrite(str(folder / images[-1]), cv2.resize(grey, (width, height), interpolation=cv2.INTER_AREA))
        sizes.append((height, width))
        focals.append(focal)
    return tuple(sizes), tuple(focals), tuple(images)


def _write_focals(store: pycolmap.Database, numbers: dict[int, int], focals: Sequence[float | None]) -> None:
    for photo, focal in enumerate(focals):
        if focal:
            camera = store.read_camera(store.read_image(numbers[photo]).camera_id)
            camera.focal_length = focal
            camera.has_prior_focal_length = True
            store.update_camera(camera)


def _choose_pairs(store: pycolmap.Database, numbers: Sequence[int]) -> list[tuple[int, int]]:
    count = len(numbers)
    everything = [(i, j) for i in range(count) for j in range(i + 1, count)]
    if count <= EXHAUSTIVE:
        return everything
    similarity = _similarity([_largest_features(store, number) for number in numbers])
    order = np.argsort(-similarity, axis=1, kind="stable")[:, :PARTNERS]
    near = {(min(i, j), max(i, j)) for i in range(count) for j in order[i].tolist() if i != j}
    return [(i, j) for i, j in everything if (i, j) in near or j - i <= 2]


def _largest_features(store: pycolmap.Database, number: int) -> np.ndarray:
    """Unit descriptors [n, 128] of a photo's largest features."""
    keypoints = store.read_keypoints(number)
    scale = np.hypot(keypoints[:, 2], keypoints[:, 4]) if keypoints.shape[1] == 6 else keypoints[:, 2]
    largest = np.argsort(-scale, kind="stable")[:SAMPLED_FEATURES]
    descriptors = store.read_descriptors(number).data[largest].astype(np.float32)
    return np.asarray(descriptors / np.maximum(np.linalg.norm(descriptors, axis=1, keepdims=True), 1))


def _similarity(descriptors: Sequence[np.ndarray]) -> np.ndarray:
    """Features of i whose nearest feature in j is clearly nearer than the second [photos, photos]."""
    count = len(descriptors)
    similarity = np.zeros((count, count))
    for i, own in enumerate(descriptors):
        for j, other in enumerate(descriptors):
            if i == j or min(len(own), len(other)) < 2:
                continue
            cosines = np.partition(own @ other.T, -2, axis=1)[:, -2:]
            second, first = (np.sqrt(np.maximum(2 - 2 * cosine, 0)) for cosine in cosines.T)
            similarity[i, j] = np.count_nonzero(first < 0.8 * second)
    return similarity + similarity.T


def _match(database: Path, folder: Path, pairs: Sequence[tuple[str, str]], seed: int) -> None:
    listing = folder / "pairs.txt"
    listing.write_text("".join(f"{first} {second}\n" for first, second in pairs))
    pairing = pycolmap.ImportedPairingOptions()
    pairing.match_list_path = listing
    matching = pycolmap.FeatureMatchingOptions()
    matching.use_gpu = False
    verification = pycolmap.TwoViewGeometryOptions()
    verification.ransac.random_seed = seed
    pycolmap.match_image_pairs(
        database, matching_options=matching, pairing_options=pairing, verification_options=verification
    )


def _verified_pairs(
    store: pycolmap.Database, photos: dict[int, int], keypoints: Sequence[np.ndarray]
) -> tuple[Pair, ...]:
    pairs = []
    for pair_id, geometry in zip(*store.read_two_view_geometries(), strict=True):
        matches = geometry.inlier_matches
        if geometry.config in UNRELATED or not len(matches):
            continue
        one, two = (photos[number] for number in pycolmap.pair_id_to_image_pair(pair_id))
        pixels = {one: keypoints[one][matches[:, 0]], two: keypoints[two][matches[:, 1]]}
        first, second = min(one, two), max(one, two)
        pairs.append(Pair(first, second, pixels[first], pixels[second]))
    return tuple(sorted(pairs, key=lambda pair: (pair.first, pair.second)))
