"""The search for cameras: SIFT for all photos, and another matcher for those that SIFT matches badly."""

import shutil
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

import numpy as np

from querysplat_cli.encoders.base import Matching
from querysplat_cli.encoders.classical.epipolar import epipolar_support
from querysplat_cli.encoders.classical.features import are_large
from querysplat_cli.encoders.classical.few_focals import few_placed
from querysplat_cli.encoders.classical.learned_matchers import LearnedMatcher, find_learned_matcher
from querysplat_cli.encoders.classical.learned_matches import all_pairs, weak_pairs, with_learned_matches
from querysplat_cli.encoders.classical.learned_policy import LEARNED_POLICY
from querysplat_cli.encoders.classical.mapping import Mapped, map_photos, without_misplaced
from querysplat_cli.encoders.classical.matches import Matches, matched
from querysplat_cli.encoders.classical.policy import CAMERA_POLICY
from querysplat_cli.encoders.classical.pure_rotation import placed_by_rotation
from querysplat_cli.encoders.classical.resting_matches import without_resting_matches
from querysplat_cli.encoders.classical.several_lenses import with_lenses_apart
from querysplat_cli.encoders.classical.sparse_model import SparseModel
from querysplat_cli.encoders.classical.support_policy import SUPPORT_POLICY
from querysplat_cli.encoders.classical.supported_matches import with_supported_matches
from querysplat_cli.encoders.classical.tilted_views import with_tilted_views
from querysplat_cli.runtime.choices import Matcher
from querysplat_cli.runtime.errors import MissingPart
from querysplat_cli.runtime.progress import Progress
from querysplat_cli.scene.views import Photo


@dataclass(frozen=True)
class MatcherChoice:
    """The matcher that the user wants; `weights` is a folder to look into for those of networks."""

    matcher: Matcher = "auto"
    weights: Path | None = None

    def network(self) -> LearnedMatcher:
        """The learned matcher, or for `auto` the first one that is here. Raises MissingPart where there is none."""
        if self.matcher in ("disk-lightglue", "xfeat"):
            return find_learned_matcher(self.matcher, self.weights)
        lacking = None
        for name in LEARNED_POLICY.preferred:
            try:
                return find_learned_matcher(name, self.weights)
            except MissingPart as missing:
                lacking = lacking or missing
        assert lacking
        raise lacking


AUTOMATIC = MatcherChoice()


@dataclass(frozen=True)
class Found:
    """Matches and their model, None where there is none. `matching` is what a network did, if one was wanted.

    `warnings` say that the photos do not share a lens, where they do not.
    """

    matches: Matches
    model: SparseModel | None
    matching: Matching | None
    warnings: tuple[str, ...] = ()


@dataclass(frozen=True)
class _Trial:
    """Matches and their model before the final bundle adjustment."""

    matches: Matches
    mapped: Mapped | None
    matching: Matching | None = None

    @staticmethod
    def of(matches: Matches, photos: Sequence[Photo], seed: int) -> "_Trial":
        """The matches mapped; of two photos, those that the cameras explain."""
        mapped = map_photos(matches, photos, seed=seed)
        if mapped:
            mended = without_misplaced(mapped, matches, seed)
            whole = len(mended.model.cameras) == len(mapped.model.cameras)
            # A photo that is left out may be a zoomed one.
            apart = with_lenses_apart(mended if whole else mapped, matches, photos, seed)
            mapped = without_misplaced(apart, matches, seed)
        return _Trial(replace(matches, pairs=mapped.pairs) if mapped else matches, mapped)

    def refined(self, photos: Sequence[Photo], seed: int) -> Found:
        if self.matches.few:
            few = few_placed(self.mapped, self.matches, photos, seed)
            if few:
                matches = replace(self.matches, pairs=few.mapped.pairs)
                return Found(matches, few.refined, self.matching, few.warnings)
        elif self.mapped:
            return Found(self.matches, self.mapped.refined(self.matches), self.matching, self.mapped.warnings)
        return Found(self.matches, None, self.matching)


def search(photos: Sequence[Photo], choice: MatcherChoice, *, seed: int, progress: Progress) -> Found:
    """Matches and a model of the photos.

    Where SIFT leaves photos out, or has few matches of a few photos, `auto` matches these again: a few photos with
    affine SIFT and then, where one is installed, with a network; more photos with the network first. Raises MissingPart
    where the chosen matcher is not installed.
    """
    with matched(photos, seed=seed, progress=progress) as matches:
        progress("placing cameras", 0.6)
        matches = without_resting_matches(matches, seed=seed)
        if placed_by_rotation(matches):  # more matches of such photos would be wrong ones
            return Found(matches, None, None)
        trial = _Trial.of(matches, photos, seed)
        if choice.matcher == "sift":
            return trial.refined(photos, seed)
        if matches.few and _wants_support(trial, choice.matcher):
            progress("matching again", 0.65)
            search_again = partial(with_supported_matches, photos=photos, seed=seed)
            trial, _ = _after(trial, search_again, _better, photos, seed)
        if choice.matcher != "sift-affine":
            trial = _with_network(photos, trial, choice, seed, progress)
        affine = _for_affine(trial, choice.matcher, large=are_large(photos))
        if affine and are_large(photos):
            progress("matching again", 0.7)
            search_again = partial(with_tilted_views, weak=affine, seed=seed)
            found, _ = _after(trial, search_again, _better, photos, seed)
            return replace(found, matching=trial.matching).refined(photos, seed)
        if not affine:
            return trial.refined(photos, seed)

    def once_more(text: str, fraction: float) -> None:
        progress(f"{text} again", 0.7 + 0.45 * fraction)

    with matched(photos, seed=seed, progress=once_more, effort=CAMERA_POLICY.thorough) as again:
        return _better(trial, replace(_Trial.of(again, photos, seed), matching=trial.matching)).refined(photos, seed)


def _wants_support(trial: _Trial, matcher: Matcher) -> bool:
    """Whether affine SIFT matches a few photos again: where cameras are missing, or few matches determine them."""
    if matcher != "auto" or trial.mapped is None:
        return matcher in ("auto", "sift-affine")
    support = epipolar_support(trial.mapped.model, trial.matches)
    enough = SUPPORT_POLICY.enough_matches * (len(trial.matches.sizes) - 1)
    return support.explained < enough or not support.sound or bool(_missing(trial))


def _for_affine(trial: _Trial, matcher: Matcher, *, large: bool) -> list[int]:
    """Of many photos those that affine SIFT searches; none where these are too many for the time it takes."""
    count, most = len(trial.matches.sizes), CAMERA_POLICY.thorough_photos
    if trial.matches.few:
        return []
    if matcher == "sift-affine":
        return list(range(count))
    if matcher != "auto":
        return []
    weak = _missing(trial)
    # In large photos only the weak ones are searched again, in others all of them.
    searched = len(weak) if large else count
    return weak if searched * count <= most**2 else []


def _with_network(
    photos: Sequence[Photo], trial: _Trial, choice: MatcherChoice, seed: int, progress: Progress
) -> _Trial:
    """The trial after the network has matched the pairs that need it, or all pairs where the user chose the network."""
    chosen = choice.matcher != "auto"
    pairs = all_pairs(trial.matches) if chosen else weak_pairs(trial.matches, _wanting(trial))
    if not pairs:
        return trial
    try:
        matcher = choice.network()
    except MissingPart as missing:
        if chosen:
            raise
        now = _agreeing(trial.matches, pairs)
        return replace(trial, matching=Matching("", len(pairs), (now, now), missing=missing.message))
    progress(f"matching {len(pairs)} pairs with {matcher.name}", 0.65)
    seconds = 0.0

    def match(matches: Matches) -> Matches:
        nonlocal seconds
        start = time.monotonic()
        more = with_learned_matches(matches, photos, pairs, matcher, seed=seed)
        seconds = time.monotonic() - start
        progress("placing cameras", 0.7)
        return more

    def choose(first: _Trial, second: _Trial) -> _Trial:
        return second if chosen and second.mapped else _better(first, second)

    kept, second = _after(trial, match, choose, photos, seed)
    agreeing = _agreeing(trial.matches, pairs), _agreeing(second.matches, pairs)
    return replace(kept, matching=Matching(matcher.name, len(pairs), agreeing, round(seconds, 2), kept is second))


def _after(
    first: _Trial,
    search_again: Callable[[Matches], Matches],
    choose: Callable[[_Trial, _Trial], _Trial],
    photos: Sequence[Photo],
    seed: int,
) -> tuple[_Trial, _Trial]:
    """The chosen one of `first` and the trial after another search, and the latter.

    A search changes COLMAP's database. Where the first trial is chosen, its database is put back.
    """
    database = first.matches.database
    before = database.with_name("before.db")
    shutil.copyfile(database, before)
    second = _Trial.of(without_resting_matches(search_again(first.matches), seed=seed), photos, seed)
    kept = choose(first, second)
    if kept is first:
        before.replace(database)
    return kept, second


def _agreeing(matches: Matches, pairs: Sequence[tuple[int, int]]) -> int:
    wanted = set(pairs)
    return sum(len(pair) for pair in matches.pairs if pair.ends in wanted)


def _wanting(trial: _Trial) -> list[int]:
    """Photos for which a network is asked: all of a few, and of more photos those that have no camera."""
    return list(range(len(trial.matches.sizes))) if trial.matches.few else _missing(trial)


def _better(first: _Trial, second: _Trial) -> _Trial:
    """The second trial where it is sound and places more photos, else the first one.

    Of a few photos, it need not be sound, and as many are enough when it explains more matches of its own.
    """
    if second.mapped is None:
        return first
    if first.mapped is None:
        return second
    new, few = epipolar_support(second.mapped.model, second.matches), first.matches.few
    gain = len(second.mapped.model.cameras) - len(first.mapped.model.cameras)
    if few and gain == 0:
        gain = new.explained - epipolar_support(first.mapped.model, first.matches).explained
    return second if gain > 0 and (few or new.sound) else first


def _missing(trial: _Trial) -> list[int]:
    """Photos without a camera that a longer search may place: neither blurred ones nor those of another place."""
    matches = trial.matches
    placed = set(trial.mapped.model.cameras) if trial.mapped else set()
    enough = CAMERA_POLICY.few_features * float(np.median(matches.features))
    missing = []
    for photo, features in enumerate(matches.features):
        partners = matches.partners(photo)
        elsewhere = bool(placed and partners) and placed.isdisjoint(partners)
        if photo not in placed and features >= enough and not elsewhere:
            missing.append(photo)
    return missing
