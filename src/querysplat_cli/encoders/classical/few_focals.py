"""Three or four photos without EXIF: the focal length from which their cameras are found.

The final adjustment takes a focal length to the nearest minimum of its cost, and matches are verified with the focal
length that comes first. So the photos are placed from several focal lengths, as two photos are. Those cameras are taken
that explain all matches best under the prior.
"""

import shutil
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import combinations
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
import pycolmap

from querysplat_cli.encoders.classical.epipolar import epipolar_error
from querysplat_cli.encoders.classical.least_squares import Loss
from querysplat_cli.encoders.classical.lens_prior import lens_prior
from querysplat_cli.encoders.classical.mapping import Mapped, map_photos
from querysplat_cli.encoders.classical.matches import Matches
from querysplat_cli.encoders.classical.policy import CAMERA_POLICY
from querysplat_cli.encoders.classical.several_lenses import few_refined
from querysplat_cli.encoders.classical.sparse_model import SparseModel
from querysplat_cli.encoders.classical.verified_pairs import Pair, read_candidates
from querysplat_cli.scene.views import Photo


@dataclass(frozen=True)
class FewPhotos:
    """A model of two to four photos and its final form; `warnings` say that the photos do not share a lens."""

    mapped: Mapped
    refined: SparseModel
    warnings: tuple[str, ...]

    @staticmethod
    def of(mapped: Mapped | None, matches: Matches) -> "FewPhotos | None":
        return FewPhotos(mapped, *few_refined(mapped, matches)) if mapped else None


def few_placed(mapped: Mapped | None, matches: Matches, photos: Sequence[Photo], seed: int) -> FewPhotos | None:
    """`mapped` of two to four photos refined, or their model from another focal length where that costs less.

    Pairs of three and four photos are verified anew with each focal length of `few_focals`. The database of `matches`
    follows. Two photos, and those whose EXIF states their focal lengths, keep `mapped`.
    """
    best = FewPhotos.of(mapped, matches)
    if len(matches.sizes) == 2 or all(matches.focals):
        return best
    with pycolmap.Database.open(matches.database) as store:
        found = (read_candidates(store, *ends) for ends in combinations(range(len(matches.sizes)), 2))
        candidates = [pair for pair in found if len(pair)]
    lowest = _cost(best, matches, candidates)
    with TemporaryDirectory(dir=matches.folder) as folder:
        taken = Path(folder, "taken.db")
        for trial in _trials(matches, candidates, Path(folder), seed):
            again = FewPhotos.of(map_photos(trial, photos, seed=seed), trial)
            cost = _cost(again, matches, candidates)
            if cost < lowest:
                best, lowest = again, cost
                shutil.copy(trial.database, taken)
        if taken.exists():
            shutil.copy(taken, matches.database)
    return best


def _trials(matches: Matches, candidates: Sequence[Pair], folder: Path, seed: int) -> Iterator[Matches]:
    """The matches verified with each focal length, in a copy of their database that is overwritten by the next one."""
    pairs = [each.ends for each in candidates]
    trial = replace(matches, folder=folder)
    for deviations in CAMERA_POLICY.few_focals:
        shutil.copy(matches.database, trial.database)
        with pycolmap.Database.open(trial.database) as store:
            store.clear_two_view_geometries()
            for photo, (stated, expected) in enumerate(zip(matches.focals, matches.expected_focals, strict=True)):
                if not stated:
                    camera = store.read_camera(store.read_image(photo + 1).camera_id)
                    focal = expected.pixels * np.exp(deviations * expected.spread)
                    camera.params = [focal, *camera.params[1:]]
                    store.update_camera(camera)
        yield trial.verified_again(pairs, CAMERA_POLICY.ordinary, seed)


def _cost(found: FewPhotos | None, matches: Matches, candidates: Sequence[Pair]) -> float:
    """What the refined cameras leave unexplained of all matches, right and wrong ones, and what their lenses cost."""
    if found is None:
        return np.inf
    policy, cameras = CAMERA_POLICY, found.refined.cameras
    errors = [
        epipolar_error(pair, *(cameras[photo] for photo in pair.ends))
        if all(photo in cameras for photo in pair.ends)
        else np.full(len(pair), np.inf)
        for pair in candidates
    ]
    worst = np.minimum(np.concatenate([*errors, []]), policy.epipolar_tolerance)
    loss = Loss(policy.adjustment_loss_scale, min(1.0, policy.independent_observations / max(len(worst), 1)))
    return loss.total(worst**2) + _lens_cost(found.refined, matches)


def _lens_cost(model: SparseModel, matches: Matches) -> float:
    """What the lenses of the model cost under their prior, each once."""
    lenses = {
        (float(np.log(camera.focal[0])), *camera.principal, *camera.distortion[:2]): photo
        for photo, camera in model.cameras.items()
    }
    prior, photos = lens_prior(matches.sizes, matches.focals, matches.expected_focals), list(lenses.values())
    return replace(prior, mean=prior.mean[photos], sigma=prior.sigma[photos]).cost(np.array(list(lenses)))
