"""Generated splits, for scenes that the authors' splits do not cover."""

import random
from collections.abc import Sequence

from querysplat_cli.evaluation.policy import EVALUATION_POLICY
from querysplat_cli.evaluation.splits import Case, FrameRef, Split
from querysplat_cli.runtime.errors import ImpossibleScene
from querysplat_cli.scene.formats.dataset import CapturedScene

SCALES = ("small", "medium", "large")
INTERVALS = {2: (6, 12, 24), 4: (4, 8, 14), 12: (2, 3, 4)}
"""Frames from one input to the next, by the number of inputs, for each scale. The authors' windows are not
published; these fit scenes of 50 frames and more."""


def generate(scenes: Sequence[CapturedScene], dataset: str, views: int, scale: str, *, cases: int, seed: int) -> Split:
    """A split of `cases` cases, taken from the scenes in turn. The same seed gives the same split.

    Neighbouring inputs are `INTERVALS[views]` frames apart, counted on disk. Interpolation targets lie between the
    first and the last input. Extrapolation targets lie at most an interval before the first or after the last input,
    or as many frames as there are targets if that is more. Raises ImpossibleScene when no scene has enough frames.
    """
    interval = INTERVALS[views][SCALES.index(scale)]
    chance = random.Random(f"{seed} {views} {scale}")
    able = scenes_for(scenes, views, scale)
    if not able:
        need = (views - 1) * interval + 1 + EVALUATION_POLICY.generated_targets
        raise ImpossibleScene(
            f"{views} views, {scale}: no scene has the {need} frames that an interval of {interval} needs",
            "Choose other --views or --scales, or give scenes with more frames.",
        )
    starts = {scene.name: _starts(len(scene.frames), views, interval) for scene in able}
    for scene in able:
        chance.shuffle(starts[scene.name])
    drawn = []
    for number in range(cases):
        scene, turn = able[number % len(able)], number // len(able)
        start = starts[scene.name][turn % len(starts[scene.name])]
        drawn.append(_case(number, scene, dataset, start, views, interval, chance))
    return Split(f"{views}views_{scale}", dataset, views, scale, tuple(drawn))


def scenes_for(scenes: Sequence[CapturedScene], views: int, scale: str) -> list[CapturedScene]:
    """Those that have frames enough for a case of so many views and this scale."""
    interval = INTERVALS[views][SCALES.index(scale)]
    return [scene for scene in scenes if _starts(len(scene.frames), views, interval)]


def _starts(count: int, views: int, interval: int) -> list[int]:
    """Positions of the first input with enough frames for extrapolation before and after the inputs."""
    targets, span = EVALUATION_POLICY.generated_targets, (views - 1) * interval
    reach = max(interval, targets)
    return [start for start in range(max(0, count - span)) if len(_outside(start, span, reach, count)) >= targets]


def _outside(start: int, span: int, reach: int, count: int) -> list[int]:
    before = range(max(0, start - reach), start)
    after = range(start + span + 1, min(count, start + span + 1 + reach))
    return [*before, *after]


def _case(
    number: int, scene: CapturedScene, dataset: str, start: int, views: int, interval: int, chance: random.Random
) -> Case:
    targets, span = EVALUATION_POLICY.generated_targets, (views - 1) * interval
    inputs = range(start, start + span + 1, interval)
    between = [i for i in range(start + 1, start + span) if i not in inputs]
    outside = _outside(start, span, max(interval, targets), len(scene.frames))
    positions = {
        "input": list(inputs),
        "interp": sorted(chance.sample(between, targets)),
        "extrap": sorted(chance.sample(outside, targets)),
    }
    groups = {group: tuple(_ref(scene, dataset, i) for i in chosen) for group, chosen in positions.items()}
    return Case(f"{scene.name}_{number:03d}", scene.name, groups)


def _ref(scene: CapturedScene, dataset: str, position: int) -> FrameRef:
    frame = scene.frames[position]
    return FrameRef("/".join(part for part in (dataset, scene.name, frame.folder, frame.name) if part), frame.index)
