"""Cameras of photos by structure from motion, and what is done when that finds none."""

import hashlib
from collections import defaultdict
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from querysplat_cli.encoders.base import CameraRequest, Matching, PosedViews
from querysplat_cli.encoders.classical.camera_warnings import camera_warnings
from querysplat_cli.encoders.classical.epipolar import median_epipolar_error
from querysplat_cli.encoders.classical.focal_from_lines import expected_focals, told_by_lines
from querysplat_cli.encoders.classical.matches import Matches, matched
from querysplat_cli.encoders.classical.policy import CAMERA_POLICY
from querysplat_cli.encoders.classical.pure_rotation import placed_alone, placed_by_rotation
from querysplat_cli.encoders.classical.search import AUTOMATIC, Found, MatcherChoice, search
from querysplat_cli.encoders.classical.sparse_model import SparseModel, as_posed_views
from querysplat_cli.encoders.classical.triangulation import triangulated
from querysplat_cli.encoders.holdout import select_views
from querysplat_cli.runtime.errors import ImpossibleScene
from querysplat_cli.runtime.progress import Progress
from querysplat_cli.scene.cameras import PhotoCamera
from querysplat_cli.scene.filed_pixels import release
from querysplat_cli.scene.match_cameras import match_cameras
from querysplat_cli.scene.views import LeftOut, Photo


@dataclass(frozen=True)
class Placement:
    """Cameras of some photos, by photo number.

    `epipolar_error` is the median distance of the matches from their epipolar lines, in longer sides of a photo.
    """

    model: SparseModel
    left_out: tuple[LeftOut, ...] = ()
    warnings: tuple[str, ...] = ()
    epipolar_error: float | None = None
    matching: Matching | None = None
    chance_pairs: int = 0


def estimate_cameras(
    photos: Sequence[Photo], request: CameraRequest, progress: Progress, choice: MatcherChoice = AUTOMATIC
) -> PosedViews:
    """Cameras of the photos, and the photos undistorted. Photos keep their order.

    The camera of the first photo placed is the origin. The median depth of the points, over all views that observe
    them, is 1. Known cameras keep their poses up to this origin and unit. Where the camera turned without moving,
    all cameras stand at one place and there are no points. A single photo gets the field of view that EXIF states,
    or that its straight lines tell, or else 45°. `choice` of the matcher counts where cameras are unknown. Where no two
    photos can be related, one of two to four is used; raises ImpossibleScene where there are more, and where masks hide
    all of every photo.
    """
    originals, copies = _without_copies(photos, request.known)
    if request.known is not None:
        placement = _place_known(originals, request.known, seed=request.seed, progress=progress)
    elif len(originals) == 1:
        placement = _place_alone(originals[0], seed=request.seed)
    else:
        placement = _place(originals, choice, seed=request.seed, progress=progress)
    progress("removing lens distortion", 0.9)
    posed, hidden = _without_hidden(as_posed_views(placement.model, originals, request.max_size))
    longer_side = max(posed.cameras.height, posed.cameras.width)
    return replace(
        posed,
        left_out=(*copies, *placement.left_out, *hidden),
        warnings=placement.warnings,
        epipolar_error_px=placement.epipolar_error and placement.epipolar_error * longer_side,
        matching=placement.matching,
        chance_pairs=placement.chance_pairs,
    )


def _without_hidden(posed: PosedViews) -> tuple[PosedViews, list[LeftOut]]:
    """The views of which at least one pixel takes part, and the others: there is nothing to score them on.

    A mask of specks or of a thin line has no pixel left where the picture is reduced or straightened.
    """
    names, rows = posed.views.names, [row for row, mask in enumerate(posed.views.masks) if mask.any()]
    if not rows:
        raise ImpossibleScene(f"the mask of {names[0]} hides all of it", "White pixels of a mask take part.")
    if len(rows) == len(names):
        return posed, []
    why = "its mask hides all of it at the working size"
    return select_views(posed, rows), [LeftOut(name, why) for row, name in enumerate(names) if row not in rows]


def _without_copies(
    photos: Sequence[Photo], known: Mapping[str, PhotoCamera] | None
) -> tuple[list[Photo], list[LeftOut]]:
    """The photos that differ from all others, in their order, and the copies.

    Of copies the one that its mask hides most of stays, so that what is masked in one does not come back from the
    other. Where each mask hides something that the other shows, both stay. With `known` cameras, a copy with a camera
    is none of one without.
    """
    if not photos:
        raise ImpossibleScene("there is no photo to make a scene of", "Give at least two photos of one place.")
    same = defaultdict[tuple[bool, tuple[int, ...], bytes], list[Photo]](list)
    for photo in photos:
        content = hashlib.sha256(np.ascontiguousarray(photo.pixels).data).digest()
        release(photo)
        same[known is None or photo.name in known, photo.pixels.shape, content].append(photo)
    copies = {}
    for group in same.values():
        kept: list[Photo] = []
        for photo in sorted(group, key=_pixels_shown):
            first = next((each for each in kept if _shows_no_more(each, photo)), None)
            if first is None:
                kept.append(photo)
            else:
                masked = "" if _shows_no_more(photo, first) else ", of which more is masked"
                copies[photo.name] = LeftOut(photo.name, f"it is the same picture as {first.name}{masked}")
            release(photo)
    originals = [photo for photo in photos if photo.name not in copies]
    return originals, [copies[photo.name] for photo in photos if photo.name in copies]


def _pixels_shown(photo: Photo) -> int:
    return photo.height * photo.width if photo.mask is None else int(np.count_nonzero(photo.mask))


def _shows_no_more(one: Photo, other: Photo) -> bool:
    """Whether what `one` shows of the picture, `other` shows, too."""
    if other.mask is None:
        return True
    return one.mask is not None and not bool((one.mask & ~other.mask).any())


def _place(photos: Sequence[Photo], choice: MatcherChoice, *, seed: int, progress: Progress) -> Placement:
    found = search(photos, choice, seed=seed, progress=progress)
    matches, model = found.matches, found.model
    # Tested first: with a wrong focal length, structure from motion explains a turning camera as a moving one.
    turned = placed_by_rotation(matches)
    if turned:
        sentence = "the camera turned but did not move, so distances cannot be measured"
        return Placement(turned, _left_out(photos, matches, turned), (sentence,))
    if model is None:
        return _place_clearest(photos, found, seed)
    return Placement(
        model,
        _left_out(photos, matches, model),
        (*found.warnings, *camera_warnings(model, matches)),
        median_epipolar_error(model, matches),
        found.matching,
        matches.chance_pairs,
    )


def _place_clearest(photos: Sequence[Photo], found: Found, seed: int) -> Placement:
    """Of a few photos that nothing relates, the one with the most detail, alone. More photos are refused."""
    matches = found.matches
    count, hint = len(photos), "photos that overlap by at least half, from places a step apart, make one scene"
    if matches.pairs:
        why = f"the {count} photos overlap too little to find their cameras"
    else:
        why = f"no two of the {count} photos show the same thing"
    if count > CAMERA_POLICY.few_photos or not any(matches.features):
        raise ImpossibleScene(why, f"{hint.capitalize()}.")
    clearest = int(np.argmax(matches.features))
    name = photos[clearest].name
    alone = _place_alone(photos[clearest], clearest, seed=seed)
    left_out = tuple(LeftOut(photo.name, f"nothing places it beside {name}") for photo in photos if photo.name != name)
    warnings = f"{why}, so only {name} is used: {hint}", *alone.warnings
    return replace(alone, left_out=left_out, warnings=warnings, matching=found.matching)


def _place_alone(photo: Photo, number: int = 0, *, seed: int) -> Placement:
    size = photo.height, photo.width
    expected = expected_focals([photo], [size], seed=seed)[0]
    if photo.focal:
        focal, source = photo.focal, "is taken from EXIF"
    elif told_by_lines(expected):
        focal, source = expected.pixels, "follows from its straight lines"
    else:
        focal, source = CAMERA_POLICY.assumed_focal * max(size), "is assumed"
    field = np.degrees(2 * np.arctan(max(size) / focal / 2))
    sentence = f"one photo has no parallax, and its field of view ({field:.0f}°) {source}"
    return Placement(placed_alone(focal, size, number), (), (sentence,))


def _place_known(
    photos: Sequence[Photo], known: Mapping[str, PhotoCamera], *, seed: int, progress: Progress
) -> Placement:
    cameras, left_out = match_cameras(photos, known)
    if not cameras:
        raise ImpossibleScene(
            f"none of the {len(photos)} photos has a usable camera in the given poses",
            f"{left_out[0].name}: {left_out[0].why}. The names in the file must be those of the photos.",
        )
    used = [photos[i] for i in cameras]
    with matched(used, seed=seed, progress=progress, known=list(cameras.values())) as matches:
        progress("triangulating", 0.6)
        model = triangulated(list(cameras.values()), matches, seed=seed)
    numbers = list(cameras)
    renumbered = SparseModel(
        {numbers[i]: camera for i, camera in model.cameras.items()},
        model.points,
        {numbers[i]: rows for i, rows in model.seen.items()},
        {numbers[i]: pixels for i, pixels in model.pixels.items()},
    )
    return Placement(
        renumbered,
        tuple(left_out),
        camera_warnings(model, matches, known=True),
        median_epipolar_error(model, matches),
    )


def _left_out(photos: Sequence[Photo], matches: Matches, model: SparseModel) -> tuple[LeftOut, ...]:
    enough = CAMERA_POLICY.few_features * float(np.median(matches.features))
    reasons = []
    for number, photo in enumerate(photos):
        if number in model.cameras:
            continue
        partners = matches.partners(number)
        if matches.features[number] < enough:
            why = "it has too little detail to match: blurred, dark or plain"
        elif set(partners) & set(model.cameras):
            why = "it overlaps too little with the photos used"
        elif partners:
            names = ", ".join(photos[i].name for i in partners[:3])
            why = f"it shows another place, together with {names}"
        else:
            why = "it shows nothing that another photo shows"
        reasons.append(LeftOut(photo.name, why))
    return tuple(reasons)
