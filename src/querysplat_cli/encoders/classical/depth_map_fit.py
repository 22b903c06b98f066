"""Depth maps that came with the photos, in the unit of the scene, beside what stereo measures.

A sensor states depth in its own unit, and its camera differs a little from the photo's. A network states inverse depth
up to a scale and a shift. So each map is fitted to the depth that the photos confirm.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float

from querysplat_cli.encoders.base import UsedDepthMaps
from querysplat_cli.encoders.classical.consistency import confirm
from querysplat_cli.encoders.classical.depth_policy import DEPTH_POLICY
from querysplat_cli.encoders.classical.neighbours import InverseRange
from querysplat_cli.encoders.classical.patchmatch import Source
from querysplat_cli.encoders.classical.stereo import Measurement
from querysplat_cli.scene.depth_maps import of_one_surface


@dataclass(frozen=True)
class FittedDepth:
    """The maps as inverse depth [views, height, width] in 1 / scene units; 0 where there is none.

    `used` says what became of the maps, and `refused` are the views whose maps do not fit the photos.
    """

    inverse: np.ndarray
    used: UsedDepthMaps
    refused: tuple[int, ...]

    def ranges(self, ranges: Sequence[InverseRange]) -> list[InverseRange]:
        """Ranges of inverse depth that hold those of the maps, too."""
        found = []
        for limits, inverse in zip(ranges, self.inverse, strict=True):
            known = inverse[inverse > 0]
            far, near = np.percentile(known, (1, 99)).tolist() if len(known) else (limits.far, limits.near)
            found.append(replace(limits, far=min(limits.far, far), near=max(limits.near, near)))
        return found

    def warnings(self, names: Sequence[str]) -> tuple[str, ...]:
        """A sentence about maps that are not used; `names` are those of the views."""
        if not self.refused:
            return ()
        some = ", ".join(names[view] for view in self.refused[:3]) + (", …" if self.refused[3:] else "")
        return (f"depth maps that do not fit what the photos show are not used: {len(self.refused)} ({some})",)

    def beside(self, found: Measurement, photos: Sequence[Source], sources: Sequence[list[int]]) -> Measurement:
        """What stereo found, and the maps where it found nothing, or where they differ from what one view confirms.

        Depth of a map counts as confirmed by one view, and more where other views agree. At its edges it counts only
        there, since a sensor's pixel may show what lies on both sides.
        """
        policy = DEPTH_POLICY
        differs = np.abs(found.inverse - self.inverse) > policy.given_step * self.inverse
        doubtful = (found.confidence < policy.given_confidence) | (differs & (found.confidence < policy.given_sure))
        instead = doubtful & (self.inverse > 0)
        inverse = np.where(instead, self.inverse, found.inverse)
        shown = np.stack([photo.grey >= 0 for photo in photos])
        agreed = confirm(inverse, shown, np.zeros_like(inverse), photos, sources)
        smooth = [of_one_surface(each, policy.given_edge, policy.given_step) for each in self.inverse]
        alone = np.stack(smooth) * np.float32(policy.given_confidence)
        confidence = np.where(instead & shown, np.maximum(agreed, alone), found.confidence)
        return Measurement(inverse, confidence.astype(np.float32))


def fit_depth_maps(
    depth: Float[np.ndarray, "views height width"], found: Measurement, ranges: Sequence[InverseRange]
) -> FittedDepth:
    """The maps `depth` (camera z in any unit, 0 where there is none) in the unit of what stereo `found`.

    One unit for all maps is taken where that fits, else one for each map, else a scale and a shift of inverse depth for
    each. Maps with which stereo has little in common have the unit of all, and are refused where other maps have no
    common one. Where stereo found nothing, the middles of the maps lie where those of the `ranges` do.
    """
    given = np.divide(1, depth, out=np.zeros(depth.shape), where=depth > 0)
    sure = (found.confidence >= DEPTH_POLICY.given_sure) & (given > 0)
    with_map = np.flatnonzero((given > 0).any((1, 2))).tolist()
    unit = _unit(given, found, sure, ranges, with_map)
    pairs = {view: (given[view][sure[view]], found.inverse[view][sure[view]]) for view in with_map}
    compared = {view: pair for view, pair in pairs.items() if len(pair[0]) >= DEPTH_POLICY.given_pixels}
    fits = {view: _best(*pair, unit) for view, pair in compared.items()}
    fits = {view: fit for view, fit in fits.items() if fit[2] <= DEPTH_POLICY.given_difference}
    differences = [difference for _, _, difference in fits.values()]
    common = all(_cost(*compared[view], unit, 0.0) <= DEPTH_POLICY.given_common for view in fits)
    if common:
        fits |= {view: (unit, 0.0, 0.0) for view in with_map if view not in compared}
    fitted = np.zeros(given.shape, np.float32)
    for view, (scale, shift, _) in fits.items():
        there = given[view] > 0
        fitted[view][there] = np.maximum(scale * given[view][there] + shift, 0)
    difference = float(np.median(differences)) if differences else None
    used = UsedDepthMaps(tuple(with_map), tuple(sorted(fits)), difference, unit if common and fits else None)
    return FittedDepth(fitted, used, tuple(view for view in with_map if view not in fits))


def _unit(
    given: np.ndarray, found: Measurement, sure: np.ndarray, ranges: Sequence[InverseRange], with_map: Sequence[int]
) -> float:
    """One factor from inverse depth of all maps to that of the scene."""
    if sure.any():
        return float(np.median(found.inverse[sure] / given[sure]))
    middles = [ranges[view].middle / float(np.median(given[view][given[view] > 0])) for view in with_map]
    return float(np.median(middles)) if middles else 1.0


def _best(given: np.ndarray, wanted: np.ndarray, unit: float) -> tuple[float, float, float]:
    """Scale, shift and median relative difference of the simplest fit that is hardly worse than the others."""
    policy, best, least = DEPTH_POLICY, (unit, 0.0), np.inf
    for scale, shift in ((unit, 0.0), (float(np.median(wanted / given)), 0.0), _line(given, wanted)):
        cost = _cost(given, wanted, scale, shift)
        possible = least > policy.given_fine and 1 / policy.given_scale < scale / unit < policy.given_scale
        if possible and cost < policy.given_gain * least:
            best, least = (scale, shift), cost
    return *best, float(np.median(np.abs(best[0] * given + best[1] - wanted) / wanted))


def _line(given: np.ndarray, wanted: np.ndarray) -> tuple[float, float]:
    """Scale and shift by sample consensus: of lines through two pixels, the one that most pixels lie close to."""
    policy, chance = DEPTH_POLICY, np.random.default_rng(0)
    some = np.sort(chance.integers(0, len(given), policy.given_samples))
    given, wanted = given[some], wanted[some]
    order = np.argsort(given)
    third = max(len(order) // 3, 1)
    low, high = (chance.choice(part, policy.given_lines) for part in (order[:third], order[-third:]))
    apart = given[high] > (1 + policy.given_fine) * given[low]
    if not apart.any():
        return 0.0, 0.0
    low, high = low[apart], high[apart]
    scales = (wanted[high] - wanted[low]) / (given[high] - given[low])
    shifts = wanted[low] - scales * given[low]
    costs = [_cost(given, wanted, scale, shift) for scale, shift in zip(scales, shifts, strict=True)]
    best = int(np.argmin(costs))
    close = np.abs(scales[best] * given + shifts[best] - wanted) < policy.given_fine * wanted
    scale, shift = np.polyfit(given[close], wanted[close], 1, w=1 / wanted[close])
    return float(scale), float(shift)


def _cost(given: np.ndarray, wanted: np.ndarray, scale: float, shift: float) -> float:
    """The mean relative difference, of which large ones count as much as those that refuse a map."""
    differences = np.abs(scale * given + shift - wanted) / wanted
    return float(np.minimum(differences, DEPTH_POLICY.given_difference).mean())
