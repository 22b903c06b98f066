"""Three or four photos without EXIF: the focal length from which their cameras are found.

The final adjustment takes a focal length to the nearest minimum of its cost, and matches are verified with the focal
length that comes first. So the photos are placed from several focal lengths, as two photos are. Those cameras are taken
that explain all matches best under the prior.
"""

import shutil
from collections.abc import Iterator, Sequence
from dataclasses import replace
from itertools import combinations
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
import pycolmap

from querysplat_cli.encoders.classical.epipolar import epipolar_error
from querysplat_cli.encoders.classical.lens_prior import lens_prior
from querysplat_cli.encoders.classical.mapping import Mapped, map_photos
from querysplat_cli.encoders.classical.matches import Matches
from querysplat_cli.encoders.classical.policy import CAMERA_POLICY
from querysplat_cli.encoders.classical.several_lenses import few_refined
from querysplat_cli.encoders.classical.sparse_model import SparseModel
from querysplat_cli.encoders.classical.verified_pairs import Pair, read_candidates
from querysplat_cli.scene.views import Photo


def from_other_focals(mapped: Mapped | None, matches: Matches, photos: Sequence[Photo], seed: int) -> Mapped | None:
    """`mapped` of three or four photos, or their model from another focal length where that costs less.

    Pairs are verified anew with each focal length of `few_focals`. The database of `matches` follows. Photos whose
    EXIF states their focal lengths, and any other number of them, keep `mapped`.
    """
    if not 2 < len(matches.sizes) <= CAMERA_POLICY.few_photos or all(matches.focals):
        return mapped
    with pycolmap.Database.open(matches.database) as store:
        found = (read_candidates(store, *ends) for ends in combinations(range(len(matches.sizes)), 2))
        candidates = [pair for pair in found if len(pair)]
    best, lowest = mapped, _cost(mapped, matches, candidates)
    with TemporaryDirectory(dir=matches.folder) as folder:
        taken = Path(folder, "taken.db")
        for trial in _trials(matches, candidates, Path(folder), seed):
            mapped_again = map_photos(trial, photos, seed=seed)
            cost = _cost(mapped_again, trial, candidates)
            if cost < lowest:
                best, lowest = mapped_again, cost
                shutil.copy(trial.database, taken)
        if best is not mapped:
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


def _cost(mapped: Mapped | None, matches: Matches, candidates: Sequence[Pair]) -> float:
    """What the refined cameras leave unexplained of all matches, right and wrong ones, and what their lenses cost."""
    if mapped is None:
        return np.inf
    policy = CAMERA_POLICY
    model, _ = few_refined(mapped, matches)
    worst = (policy.epipolar_tolerance / policy.adjustment_loss_scale) ** 2
    loss = 0.0
    for pair in candidates:
        if all(photo in model.cameras for photo in pair.ends):
            error = epipolar_error(pair, *(model.cameras[photo] for photo in pair.ends))
            loss += np.log1p(np.minimum((error / policy.adjustment_loss_scale) ** 2, worst)).sum()
        else:
            loss += len(pair) * np.log1p(worst)
    weight = min(1.0, policy.independent_observations / max(sum(map(len, candidates)), 1))
    return float(weight * policy.adjustment_loss_scale**2 * loss + _prior_cost(model, matches))


def _prior_cost(model: SparseModel, matches: Matches) -> float:
    """What the lenses of the model cost under their prior, each once."""
    prior = lens_prior(matches.sizes, matches.focals, matches.expected_focals)
    lenses = {}
    for photo, camera in model.cameras.items():
        lens = (float(np.log(camera.focal[0])), *camera.principal, *camera.distortion[:2])
        lenses[lens] = (((lens - prior.mean[photo]) / prior.sigma[photo]) ** 2).sum()
    return float(prior.weight * sum(lenses.values()))
