"""How well a few photos of a set are placed, wherever they stand: random choices of so many photos.

    python benchmarks/photo_choices.py [DATA] [--sets fox dtu106] [--counts 5 8 12] [--choices 10] [--seed 21]
        [--matcher auto] [--json FILE]

DATA is the folder of the photo sets, by default $QUERYSPLAT_DATA. Each choice is placed as `querysplat reconstruct`
would, and compared with a reference: the set's own cameras (transforms.json) where it has some, otherwise the
registration of the whole set. A photo is wrong where it is not of the largest group that stands right: within 3° of the
turn that the reference has from one of them to each of the others. *Scenes* are the choices with a wrong photo. *Focal*
counts the choices whose median focal length is more than 10 % off. Seconds are those of the processor.
"""

import random
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import get_args

from common.arguments import PhotoParser
from common.output import Table, write_json
from common.pose_errors import pose_errors
from common.samples import SEED
from pairs import cameras_of, set_and_reference
from querysplat_cli.encoders.base import Encoder, EncoderOptions
from querysplat_cli.encoders.registry import find_encoder
from querysplat_cli.runtime.choices import Matcher
from querysplat_cli.scene.cameras import PhotoCamera
from querysplat_cli.scene.rotations import rotation_angles
from querysplat_cli.scene.views import Photo

import numpy as np
import torch

RIGHT_DEGREES = 3.0
FOCAL_SHARE = 0.1


@dataclass(frozen=True)
class Choice:
    """Some photos of a set by number: how many were placed, how many of these are wrong, and the median focal error."""

    set: str
    photos: tuple[int, ...]
    placed: int
    wrong: int
    focal: float | None
    seconds: float


def wrong_photos(found: dict[str, PhotoCamera], true: dict[str, PhotoCamera]) -> int:
    """How many cameras are not of the largest group that stands right."""
    turns = np.stack([true[name].w2c[:3, :3].T @ camera.w2c[:3, :3] for name, camera in found.items()])
    apart = rotation_angles(torch.from_numpy(turns[:, None] @ turns.transpose(0, 2, 1)))
    return len(found) - int((apart < RIGHT_DEGREES).sum(1).max())


def choices_of(
    name: str, photos: Sequence[Photo], encoder: Encoder, true: dict[str, PhotoCamera], picks: Sequence[tuple[int, ...]]
) -> Iterator[Choice]:
    for pick in picks:
        found, seconds = cameras_of(encoder, [photos[number] for number in pick])
        found = {each: camera for each, camera in found.items() if each in true}
        compared = pose_errors(found, true)
        focal = abs(float(np.median(compared.focal))) if compared else None
        yield Choice(name, pick, len(found), wrong_photos(found, true) if found else 0, focal, seconds)


def picks_of(photos: int, counts: Sequence[int], choices: int, seed: int) -> list[tuple[int, ...]]:
    generator = random.Random(seed)
    numbers = range(photos)
    return [tuple(sorted(generator.sample(numbers, n))) for n in counts if n < photos for _ in range(choices)]


def main() -> None:
    parser = PhotoParser(__doc__, passes=False)
    parser.add_argument("--counts", nargs="+", type=int, default=[5, 6, 7, 8, 9, 10, 12], metavar="N")
    parser.add_argument("--choices", type=int, default=10, help="of each number of photos")
    parser.add_argument("--seed", type=int, default=21, help="of the choices")
    parser.add_argument("--matcher", choices=get_args(Matcher), default="auto")
    options = parser.parse()
    encoder = find_encoder("classical", EncoderOptions(matcher=options.matcher))
    rows: list[Choice] = []
    table = Table(dict.fromkeys(("set", "choices", "placed", "wrong", "scenes", "focal"), "") | {"s": ".0f"})
    for name in options.sets:
        photos, true = set_and_reference(name, options.data, encoder)
        picks = picks_of(len(photos), options.counts, options.choices, options.seed)
        own = list(choices_of(name, photos, encoder, true, picks))
        placed = f"{sum(each.placed for each in own)} of {sum(len(each.photos) for each in own)}"
        wrong = sum(each.wrong for each in own), sum(each.wrong > 0 for each in own)
        off = sum(each.focal is None or each.focal > FOCAL_SHARE for each in own)
        table.add(name, len(own), placed, *wrong, off, sum(each.seconds for each in own))
        rows += own
    write_json(options.json, encoder_seed=SEED, seed=options.seed, rows=rows)


if __name__ == "__main__":
    main()
