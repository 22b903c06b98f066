"""SIFT features of the photos, and the verified matches between pairs of photos."""

from collections.abc import Hashable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import pycolmap

from querysplat_cli.encoders.classical.chance_pairs import remove_chance_pairs
from querysplat_cli.encoders.classical.features import (
    are_large,
    extract_features,
    image_name,
    write_grey,
    write_masks,
)
from querysplat_cli.encoders.classical.focal_from_lines import expected_focals, usual_focals
from querysplat_cli.encoders.classical.lens_prior import ExpectedFocal, usual_focal
from querysplat_cli.encoders.classical.photo_pairs import choose_pairs
from querysplat_cli.encoders.classical.policy import CAMERA_POLICY, MatchEffort
from querysplat_cli.encoders.classical.start_focals import calibrate_start
from querysplat_cli.encoders.classical.verified_pairs import (
    Pair,
    Verification,
    connected_groups,
    match_pairs,
    read_pairs,
    verify_pairs,
)
from querysplat_cli.runtime.errors import QuerySplatError
from querysplat_cli.runtime.progress import Progress
from querysplat_cli.scene.cameras import PhotoCamera, rescaled
from querysplat_cli.scene.drafts import scratch_folder
from querysplat_cli.scene.views import Photo


@dataclass(frozen=True)
class Matches:
    """Verified matches of a set of photos.

    By photo number: `sizes` are the (height, width) at which features were searched, `focals` the focal lengths in
    pixels of that size (from EXIF, or None), `expected_focals` those to be expected without EXIF, and `features` the
    numbers of features found. Pixels are of that size, centres at +0.5. `folder` holds the same for
    COLMAP, whose image numbers are ours plus one. `chance_pairs` were removed (`chance_pairs.py`).
    """

    folder: Path
    sizes: tuple[tuple[int, int], ...]
    focals: tuple[float | None, ...]
    expected_focals: tuple[ExpectedFocal, ...]
    features: tuple[int, ...]
    pairs: tuple[Pair, ...]
    chance_pairs: int = 0

    @property
    def database(self) -> Path:
        return self.folder / "matches.db"

    @property
    def few(self) -> bool:
        """Whether the photos are so few that they hardly determine their lens."""
        return len(self.sizes) <= CAMERA_POLICY.few_photos

    def focal(self, photo: int) -> float:
        """The focal length to start from, in pixels: EXIF's, or else an assumed one."""
        return self.focals[photo] or CAMERA_POLICY.assumed_focal * max(self.sizes[photo])

    def verified_again(self, changed: Sequence[tuple[int, int]], effort: MatchEffort, seed: int) -> "Matches":
        """With these pairs verified, whose matches in the database changed and have no two-view geometry."""
        verify_pairs(self.database, self.folder, changed, Verification.of(self.sizes, effort, seed))
        with pycolmap.Database.open(self.database) as store:
            return replace(self, pairs=read_pairs(store, len(self.sizes)))

    def partners(self, photo: int) -> list[int]:
        """Numbers of the photos that have matches with this one."""
        return [pair.first + pair.second - photo for pair in self.pairs if photo in pair.ends]

    def largest_group(self) -> list[int]:
        """Numbers of the largest group of photos that pairs connect, directly or through others."""
        group = connected_groups([pair.ends for pair in self.pairs], len(self.sizes))
        found: list[int] = np.flatnonzero(group == np.bincount(group).argmax()).tolist()
        return found


@contextmanager
def matched(
    photos: Sequence[Photo],
    *,
    seed: int,
    progress: Progress,
    effort: MatchEffort | None = None,
    known: Sequence[PhotoCamera] | None = None,
) -> Iterator[Matches]:
    """Features and matches of the photos. Their folder exists only inside the `with`.

    `effort` is by default the usual one for photos of this size. Photos of one size and one EXIF focal length share a
    lens; with `known`, each photo has its own camera instead. Raises QuerySplatError when the folder cannot be
    written.
    """
    effort = effort or _usual_effort(photos)
    # COLMAP writes messages to the terminal, where standard output may be the JSON of `--json`.
    pycolmap.logging.minloglevel = pycolmap.logging.FATAL.value
    with scratch_folder() as folder, _naming_the_folder(folder):
        progress("finding features", 0.0)
        sizes = write_grey(photos, folder, effort.feature_size)
        write_masks(photos, sizes, folder)
        focals = _focals(photos, sizes)
        expected = usual_focals(photos, sizes) if known else expected_focals(photos, sizes, seed=seed)
        cameras = _known_cameras(known, sizes) if known else shared_cameras(sizes, focals, expected)
        matches = Matches(folder, sizes, focals, expected, (), ())
        with pycolmap.Database.open(matches.database) as store:
            write_images(store, cameras)
        extract_features(matches.database, folder, effort)
        with pycolmap.Database.open(matches.database) as store:
            features = tuple(store.num_keypoints_for_image(i + 1) for i in range(len(photos)))
            chosen = choose_pairs(store, photos)
        progress("matching", 0.3)
        verification = Verification.of(sizes, effort, seed)

        def told(share: float) -> None:
            progress("matching", 0.3 + 0.3 * share)

        match_pairs(matches.database, folder, chosen, effort, verification, told)
        with pycolmap.Database.open(matches.database) as store:
            pairs = every = read_pairs(store, len(photos))
            if not known and len(photos) > CAMERA_POLICY.exhaustive_photos:
                pairs = remove_chance_pairs(store, pairs, len(photos), effort.fewest_inliers)
        if not known and len(photos) > CAMERA_POLICY.measured_focal_photos:
            calibrate_start(matches.database, folder, seed=seed)
        yield replace(matches, features=features, pairs=pairs, chance_pairs=len(every) - len(pairs))


def _usual_effort(photos: Sequence[Photo]) -> MatchEffort:
    policy = CAMERA_POLICY
    effort = policy.ordinary_large if are_large(photos) else policy.ordinary
    return replace(effort, most_features=policy.many_features) if len(photos) > policy.many_photos else effort


def _focals(photos: Sequence[Photo], sizes: Sequence[tuple[int, int]]) -> tuple[float | None, ...]:
    """EXIF's focal length of each photo or None, in pixels of the photos at these sizes."""
    return tuple(
        photo.focal * size[1] / photo.width if photo.focal else None for photo, size in zip(photos, sizes, strict=True)
    )


@contextmanager
def _naming_the_folder(folder: Path) -> Iterator[None]:
    """Names the folder in errors of COLMAP's database, which do not."""
    try:
        yield
    except RuntimeError as error:
        if "SQLite" not in str(error):
            raise
        raise QuerySplatError(
            f"cannot write to {folder}: {error}", "Free some space there, or set TMPDIR to another folder."
        ) from error


def shared_cameras(
    sizes: Sequence[tuple[int, int]],
    focals: Sequence[float | None],
    expected: Sequence[ExpectedFocal] | None = None,
) -> list[tuple[Hashable, pycolmap.Camera]]:
    """COLMAP's camera of each photo, with a key that is equal for photos of one lens.

    `expected` are the focal lengths without EXIF, by default the usual ones of whole photos of these sizes.
    """
    expected = expected or [usual_focal(*size) for size in sizes]
    keyed: list[tuple[Hashable, pycolmap.Camera]] = []
    few = len(sizes) <= CAMERA_POLICY.few_photos
    for (height, width), focal, assumed in zip(sizes, focals, expected, strict=True):
        guess = focal or (assumed.pixels if few else CAMERA_POLICY.assumed_focal * max(height, width))
        camera = pycolmap.Camera.create_from_model_name(1, "SIMPLE_RADIAL", guess, width, height)
        camera.has_prior_focal_length = focal is not None or few
        keyed.append(((height, width, focal and round(focal / width, 2), round(assumed.pixels / width, 2)), camera))
    return keyed


def _known_cameras(
    known: Sequence[PhotoCamera], sizes: Sequence[tuple[int, int]]
) -> list[tuple[Hashable, pycolmap.Camera]]:
    """COLMAP's camera of each photo, with a key of its own."""
    keyed: list[tuple[Hashable, pycolmap.Camera]] = []
    for photo, ((height, width), camera) in enumerate(zip(sizes, known, strict=True)):
        scaled = rescaled(camera, height, width)
        params = (*scaled.focal, *scaled.principal, *scaled.distortion)
        found = pycolmap.Camera(model="OPENCV", width=width, height=height, params=params, has_prior_focal_length=True)
        keyed.append((photo, found))
    return keyed


def write_images(store: pycolmap.Database, keyed: Sequence[tuple[Hashable, pycolmap.Camera]]) -> None:
    """One image for each photo; those with equal keys share a camera.

    This comes before the search for features, which numbers new images in the order in which its threads finish.
    """
    numbers = dict[Hashable, int]()
    for photo, (key, camera) in enumerate(keyed):
        if key not in numbers:
            numbers[key] = len(numbers) + 1
            write_lens(store, camera, numbers[key])
        image = pycolmap.Image(name=image_name(photo), camera_id=numbers[key], image_id=photo + 1)
        store.write_frame(frame_of(image), use_frame_id=True)
        store.write_image(image, use_image_id=True)


def write_lens(store: pycolmap.Database, camera: pycolmap.Camera, number: int) -> None:
    """Write a camera under a new number, alone on a rig of the same number."""
    camera.camera_id = number
    rig = pycolmap.Rig(rig_id=number)
    rig.add_ref_sensor(camera.sensor_id)
    store.write_camera(camera, use_camera_id=True)
    store.write_rig(rig, use_rig_id=True)


def frame_of(image: pycolmap.Image) -> pycolmap.Frame:
    """The frame that holds an image alone, on the rig of its camera."""
    frame = pycolmap.Frame(frame_id=image.image_id, rig_id=image.camera_id)
    frame.add_data_id(image.data_id)
    return frame
