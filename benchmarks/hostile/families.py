"""Every case, family by family."""

from collections import Counter
from collections.abc import Iterator
from dataclasses import replace

from hostile.case import Case
from hostile.evaluations import evaluations
from hostile.files import cameras, gaussians
from hostile.kills import kills
from hostile.levels import levels
from hostile.options import options
from hostile.photos import photos, pictures, weights
from hostile.scenes import scene_folder, settings, shown
from hostile.situations import situations
from hostile.sound import Sound

FAMILIES = (
    gaussians,
    levels,
    cameras,
    pictures,
    photos,
    weights,
    scene_folder,
    shown,
    settings,
    evaluations,
    options,
    situations,
    kills,
)


def all_cases(sound: Sound) -> Iterator[Case]:
    """Every case, in the order of the table. Cases that would have the same name are numbered."""
    seen: Counter[tuple[str, str]] = Counter()
    for family in FAMILIES:
        for case in family(sound):
            seen[case.family, case.what] += 1
            number = seen[case.family, case.what]
            yield case if number == 1 else replace(case, what=f"{case.what} ({number})")
