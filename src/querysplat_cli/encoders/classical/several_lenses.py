"""Photos of one size that do not share a lens, though no EXIF says so: zoomed photos, or cropped ones."""

import shutil
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import replace
from itertools import pairwise
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
import pycolmap

from querysplat_cli.encoders.classical.bundle_adjustment import bundle_adjusted
from querysplat_cli.encoders.classical.camera_warnings import field_of_view
from querysplat_cli.encoders.classical.epipolar import epipolar_support
from querysplat_cli.encoders.classical.mapping import Mapped, from_colmap, map_photos
from querysplat_cli.encoders.classical.matches import Matches, frame_of, write_lens
from querysplat_cli.encoders.classical.policy import CAMERA_POLICY
from querysplat_cli.encoders.classical.self_calibration import adjusted
from querysplat_cli.encoders.classical.sparse_model import SparseModel, mean_error, photo_error
from querysplat_cli.encoders.classical.two_views import share_a_lens
from querysplat_cli.scene.views import Photo


def with_lenses_apart(mapped: Mapped, matches: Matches, photos: Sequence[Photo], seed: int) -> Mapped:
    """The model with a lens for each group of photos of one focal length, where that explains as many matches.

    It is looked for where a photo fits much better with a lens of its own. All are then placed once with a lens each,
    which tells their focal lengths, and once more with those lenses. The database of `matches` follows. A warning says
    so. Where such a model explains fewer matches, a warning with `mapped` says that it may be wrong.
    """
    if not _differ(mapped):
        return mapped
    with TemporaryDirectory(dir=matches.folder) as folder:
        trial = replace(matches, folder=Path(folder))
        shutil.copy(matches.database, trial.database)
        shared = _lenses(trial)
        _divide_lenses(trial, list(range(len(photos))))
        alone = map_photos(trial, photos, seed=seed)
        if alone and alone.reconstruction:
            groups = _groups(alone.reconstruction, shared)
            if len(set(groups)) == len(set(shared)):
                return mapped
            _divide_lenses(trial, groups)
            apart = map_photos(trial, photos, seed=seed)
            if apart and _explains_as_much(apart, mapped.model, matches):
                shutil.copy(trial.database, matches.database)
                return replace(apart, warnings=(f"the photos do not share a lens: {_spans(apart.model)}",))
    return replace(mapped, warnings=("the photos do not seem to share a lens, so the cameras may be wrong",))


def few_refined(mapped: Mapped, matches: Matches) -> tuple[SparseModel, tuple[str, ...]]:
    """`mapped.refined` of two to four photos, and what is to be said of their lenses.

    They get a lens each where one of them fits much better then, as zoomed or cropped ones do; of two, the model has
    them already. The prior of each lens stands in for the photos that would determine it.
    """
    together = mapped.refined(matches)
    if mapped.reconstruction is None:
        differ = len({camera.focal for camera in together.cameras.values()}) > 1
        found = differ and share_a_lens(matches.sizes, matches.focals, matches.expected_focals)
        return together, (_few_lenses(together),) if found else ()
    if len(together.cameras) < 3:
        return together, ()
    divided = with_lenses(mapped.reconstruction, range(len(matches.sizes)))
    alone = bundle_adjusted(divided, matches.focals, matches.expected_focals)
    if not _fits_better(alone, together):
        return together, ()
    return alone, (_few_lenses(alone),)


def _few_lenses(model: SparseModel) -> str:
    found = f"the photos do not share a lens: {_spans(model)}"
    return f"{found}; so few hardly determine that, and the cameras may be wrong"


def focal_groups(focals: Mapping[int, float], shared: Sequence[int], gap: float) -> list[int]:
    """A lens number for each photo: photos of one number in `shared` are divided where focal lengths leave a gap.

    `focals` are in pixels, by photo. Across a gap they differ by a larger share than `gap`. Photos without a focal
    length stay with the last group of their lens.
    """
    ordered = sorted(range(len(shared)), key=lambda photo: (shared[photo], focals.get(photo, np.inf)))
    groups = [0] * len(shared)
    for before, photo in pairwise(ordered):
        starts = shared[photo] != shared[before]
        if not starts and photo in focals:
            starts = bool(np.log(focals[photo]) - np.log(focals[before]) > np.log1p(gap))
        groups[photo] = groups[before] + starts
    return groups


def with_lenses(model: pycolmap.Reconstruction, groups: Sequence[int]) -> pycolmap.Reconstruction:
    """The same placed images and points, with a camera for each group of photos, which starts as its first image's."""
    apart = pycolmap.Reconstruction()
    for number in model.reg_image_ids():
        image, lens = model.images[number], groups[number - 1] + 1
        if lens not in apart.cameras:
            camera = pycolmap.Camera(model.cameras[image.camera_id].todict())
            camera.camera_id = lens
            apart.add_camera_with_trivial_rig(camera)
        keypoints = np.array([point.xy for point in image.points2D]).reshape(-1, 2)
        copy = pycolmap.Image(name=image.name, keypoints=keypoints, camera_id=lens, image_id=number)
        apart.add_image_with_trivial_frame(copy, image.cam_from_world())
    for point in model.points3D.values():
        apart.add_point3D(point.xyz, point.track)
    return apart


def _differ(mapped: Mapped) -> bool:
    """Whether a photo has another focal length, and far smaller errors, where each has a lens of its own."""
    policy = CAMERA_POLICY
    if mapped.reconstruction is None or not mapped.fit_lens:
        return False
    if not policy.few_photos < len(mapped.model.cameras) <= policy.lens_apart_photos:
        return False
    model = mapped.adjusted
    return _fits_better(_adjusted(with_lenses(model, range(max(model.images)))), from_colmap(model))


def _fits_better(alone: SparseModel, together: SparseModel) -> bool:
    """Whether a photo has another focal length and far smaller errors in the model `alone`, with a lens for each."""
    policy = CAMERA_POLICY
    for photo, camera in alone.cameras.items():
        if len(alone.seen[photo]) < policy.lens_apart_observations:
            continue
        apart = abs(np.log(camera.focal[0] / together.cameras[photo].focal[0])) > np.log1p(policy.lens_difference)
        if apart and photo_error(alone, photo) < policy.lens_apart_error * photo_error(together, photo):
            return True
    return False


def _groups(model: pycolmap.Reconstruction, shared: Sequence[int]) -> list[int]:
    """The fewest lenses with which photos fit as well as with one each. `model` has one each."""
    alone = _adjusted(model)
    limit = CAMERA_POLICY.lens_tolerance * mean_error(alone)
    focals = {photo: camera.focal[0] for photo, camera in alone.cameras.items()}
    groups: list[int] = []
    for gap in CAMERA_POLICY.lens_gaps:
        groups = focal_groups(focals, shared, gap)
        if mean_error(_adjusted(with_lenses(model, groups))) < limit:
            break
    return groups


def _adjusted(model: pycolmap.Reconstruction) -> SparseModel:
    return from_colmap(adjusted(model, second_term=False, fit_lens=True))


def _spans(model: SparseModel) -> str:
    """The angle that each lens spans, in words."""
    count = Counter(round(field_of_view(camera)) for camera in model.cameras.values())
    return ", ".join(f"{number} span {angle}°" for angle, number in sorted(count.items()))


def _lenses(matches: Matches) -> list[int]:
    with pycolmap.Database.open(matches.database) as store:
        return [store.read_image(photo + 1).camera_id for photo in range(len(matches.sizes))]


def _divide_lenses(matches: Matches, groups: Sequence[int]) -> None:
    """Give the photos of each group a camera of their own, which starts as that of the group's first photo."""
    with pycolmap.Database.open(matches.database) as store:
        highest = max(camera.camera_id for camera in store.read_all_cameras())
        numbers = dict[int, int]()
        for photo, group in enumerate(groups):
            image = store.read_image(photo + 1)
            if group not in numbers:
                numbers[group] = highest + len(numbers) + 1
                write_lens(store, store.read_camera(image.camera_id), numbers[group])
            image.camera_id = numbers[group]
            store.update_frame(frame_of(image))
            store.update_image(image)


def _explains_as_much(new: Mapped, old: SparseModel, matches: Matches) -> bool:
    if not new.fit_lens or len(new.model.cameras) < len(old.cameras) or new.misplaced(matches):
        return False
    return epipolar_support(new.model, matches).explained >= epipolar_support(old, matches).explained
