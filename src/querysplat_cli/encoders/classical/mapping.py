"""Structure from motion: matches in, cameras and points out (COLMAP's incremental mapper)."""

import math
from collections.abc import Sequence
from copy import deepcopy
from dataclasses import dataclass, replace
from functools import cached_property, partial
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
import pycolmap

from querysplat_cli.encoders.classical.bundle_adjustment import bundle_adjusted
from querysplat_cli.encoders.classical.camera_warnings import exif_ratios, has_ordinary_lens
from querysplat_cli.encoders.classical.dense_agreement import dense_agreement
from querysplat_cli.encoders.classical.epipolar import epipolar_support
from querysplat_cli.encoders.classical.matches import Matches
from querysplat_cli.encoders.classical.policy import CAMERA_POLICY, Attempt
from querysplat_cli.encoders.classical.self_calibration import adjusted, centred, self_calibrated
from querysplat_cli.encoders.classical.sparse_model import SparseModel, mean_error, misplaced
from querysplat_cli.encoders.classical.two_views import map_two_photos
from querysplat_cli.encoders.classical.verified_pairs import Pair, read_candidates
from querysplat_cli.scene.formats.colmap import photo_camera
from querysplat_cli.scene.views import Photo


@dataclass(frozen=True)
class Mapped:
    """A model of some photos, and COLMAP's form of it where the final bundle adjustment is still to be made.

    `fit_lens`: whether COLMAP fitted the lenses. `pairs` are the matches that belong to the model. `warnings` say
    that the photos do not share a lens, where they do not.
    """

    model: SparseModel
    pairs: tuple[Pair, ...]
    reconstruction: pycolmap.Reconstruction | None = None
    fit_lens: bool = True
    warnings: tuple[str, ...] = ()

    @cached_property
    def adjusted(self) -> pycolmap.Reconstruction:
        """COLMAP's form after a bundle adjustment without priors."""
        assert self.reconstruction is not None
        return centred(self.reconstruction, fit_lens=self.fit_lens)

    def misplaced(self, matches: Matches) -> list[int]:
        """Photos that wrong matches seem to have placed, by the adjusted model.

        A few photos are not judged: their lens is not fitted yet, so that a zoomed one fits badly, too.
        """
        return [] if self.reconstruction is None or matches.few else misplaced(from_colmap(self.adjusted))

    def refined(self, matches: Matches) -> SparseModel:
        """The model after the final bundle adjustment.

        Priors take part for a few photos, and where more photos contradict the focal length that EXIF states, unless
        they fit much worse then: a photo that was cut has another one. Photos of a plane, and others that do not
        determine their focal length, fit as well with that of EXIF.
        """
        if self.reconstruction is None:
            return self.model
        if len(self.model.cameras) <= CAMERA_POLICY.few_photos:
            return self._under_priors(matches)
        found = from_colmap(self_calibrated(self.adjusted, fit_lens=self.fit_lens))
        if len(self.model.cameras) > CAMERA_POLICY.adjusted_photos or _keep_exif(exif_ratios(found, matches)):
            return found
        stated = self._under_priors(matches)
        return found if mean_error(found) < CAMERA_POLICY.contradiction * mean_error(stated) else stated

    def _under_priors(self, matches: Matches) -> SparseModel:
        assert self.reconstruction is not None
        return bundle_adjusted(self.reconstruction, matches.focals, matches.expected_focals)


def _keep_exif(ratios: Sequence[float]) -> bool:
    most = CAMERA_POLICY.stated_focal_limit * CAMERA_POLICY.stated_focal_spread
    return all(abs(math.log(ratio)) <= most for ratio in ratios)


def map_photos(matches: Matches, photos: Sequence[Photo], *, seed: int) -> Mapped | None:
    """The sound model of most photos, or None when no two photos make one.

    The search ends with the first attempt whose model is sound and contains all photos that matches connect, none of
    them misplaced. The attempt with an assumed lens is made where no other model holds half of these photos. Where no
    model is sound, it is the one that explains most of the matches: those grow with the square of the photos that see
    one thing, so that they say nothing of models of different photos.
    """
    if len(matches.sizes) == 2:
        with pycolmap.Database.open(matches.database) as store:
            candidates = read_candidates(store, 0, 1)
        agreement = partial(dense_agreement, photos)
        two = map_two_photos(candidates, matches.sizes, matches.focals, matches.expected_focals, agreement)
        return Mapped(two[0], (two[1],)) if two else None
    connected = len(matches.largest_group())
    best: tuple[tuple[int, float], Mapped] | None = None
    for attempt in _attempts(matches):
        if best and not attempt.fit_lens and best[0][0] >= max(CAMERA_POLICY.judged_photos, connected / 2):
            break  # most photos tell their lens, which need not be assumed
        for reconstruction in _mapped(matches, attempt, seed):
            model = from_colmap(reconstruction)
            support, ordinary = epipolar_support(model, matches), has_ordinary_lens(model)
            sound = support.sound and ordinary
            mapped = Mapped(model, matches.pairs, reconstruction, attempt.fit_lens)
            right = len(model.cameras) - len(mapped.misplaced(matches))
            if sound and right >= connected:
                return mapped
            worth = right if sound else 0, support.score if ordinary else support.score / 2
            if best is None or worth > best[0]:
                best = worth, mapped
    return _extended(best[1], matches, seed) if best else None


def without_misplaced(mapped: Mapped, matches: Matches, seed: int) -> Mapped:
    """The model without the photos that wrong matches have placed, or with them where they fit once it is adjusted."""
    wrong = mapped.misplaced(matches)
    if not wrong:
        return mapped
    again = _extended(_without(mapped, wrong), matches, seed)
    return _without(again, again.misplaced(matches))


def _without(mapped: Mapped, photos: Sequence[int]) -> Mapped:
    """The adjusted model without some photos, adjusted once more; `mapped` where there are none."""
    if not photos:
        return mapped
    rest = deepcopy(mapped.adjusted)
    for photo in photos:
        rest.deregister_frame(rest.images[photo + 1].frame_id)
    rest = adjusted(rest, second_term=False, fit_lens=mapped.fit_lens)
    return replace(mapped, model=from_colmap(rest), reconstruction=rest)


def _attempts(matches: Matches) -> list[Attempt]:
    """The policy's attempts; none fits the lens where the photos are too few for that."""
    return [replace(attempt, fit_lens=attempt.fit_lens and not matches.few) for attempt in CAMERA_POLICY.attempts]


def from_colmap(reconstruction: pycolmap.Reconstruction) -> SparseModel:
    """COLMAP's placed images and their points, by our photo numbers."""
    ids = sorted(reconstruction.points3D)
    row = {point: i for i, point in enumerate(ids)}
    points = np.array([reconstruction.points3D[point].xyz for point in ids]).reshape(-1, 3)
    cameras, seen, pixels = {}, {}, {}
    for image in reconstruction.images.values():
        if image.has_pose:
            photo = image.image_id - 1
            cameras[photo] = photo_camera(image, reconstruction.cameras[image.camera_id])
            observed = image.get_observation_points2D()
            rows = np.array([row[point.point3D_id] for point in observed], dtype=np.int64)
            seen[photo], first = np.unique(rows, return_index=True)
            pixels[photo] = np.array([point.xy for point in observed]).reshape(-1, 2)[first]
    order = sorted(cameras)
    return SparseModel({i: cameras[i] for i in order}, points, {i: seen[i] for i in order}, pixels)


def _mapped(
    matches: Matches, attempt: Attempt, seed: int, start: pycolmap.Reconstruction | None = None
) -> list[pycolmap.Reconstruction]:
    """COLMAP's models of the photos, or the one that extends `start`."""
    options = _options(attempt, seed, many=len(matches.sizes) > CAMERA_POLICY.many_photos)
    with TemporaryDirectory(dir=matches.folder) as folder:
        before = Path(folder, "before")
        if start:
            before.mkdir()
            start.write(before)
            options.multiple_models = False
        found = pycolmap.incremental_mapping(
            matches.database, matches.folder, Path(folder), options, before if start else ""
        )
    return [found[i] for i in sorted(found)]


def _extended(mapped: Mapped, matches: Matches, seed: int) -> Mapped:
    """The model, extended by photos that have few matches with it where that raises its score."""
    attempt = CAMERA_POLICY.extending_few if matches.few else CAMERA_POLICY.extending
    for grown in _mapped(matches, attempt, seed, mapped.reconstruction):
        model = from_colmap(grown)
        if epipolar_support(model, matches).score > epipolar_support(mapped.model, matches).score:
            mapped = replace(mapped, model=model, reconstruction=grown)
    return mapped


def _options(attempt: Attempt, seed: int, *, many: bool) -> pycolmap.IncrementalPipelineOptions:
    options = pycolmap.IncrementalPipelineOptions()
    options.min_model_size = 2
    options.ignore_watermarks = True
    options.extract_colors = False
    # With one thread and one seed, the same photos give the same bits.
    options.num_threads = 1
    options.random_seed = seed
    options.mapper.init_min_tri_angle = attempt.start_angle
    options.mapper.init_min_num_inliers = attempt.start_inliers
    options.mapper.init_max_forward_motion = attempt.forward_motion
    options.mapper.abs_pose_min_num_inliers = attempt.pose_inliers
    options.mapper.filter_min_tri_angle = attempt.point_angle
    options.mapper.abs_pose_refine_focal_length = attempt.fit_lens
    options.mapper.abs_pose_refine_extra_params = attempt.fit_lens
    options.ba_refine_focal_length = attempt.fit_lens
    options.ba_refine_extra_params = attempt.fit_lens
    if many:
        options.ba_global_frames_ratio = options.ba_global_points_ratio = CAMERA_POLICY.many_growth
        options.ba_global_function_tolerance = options.ba_local_function_tolerance = CAMERA_POLICY.many_tolerance
    options.triangulation.min_angle = attempt.point_angle
    options.triangulation.ignore_two_view_tracks = False
    return options
