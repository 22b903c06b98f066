"""Defaults of the optimisation in Gaussian space that follows the one in feature space: sizes, Gaussians, time."""

import math
from collections.abc import Mapping
from dataclasses import dataclass, field

from querysplat_cli.runtime.choices import FullSizeLevel
from querysplat_cli.scene.photos import WHOLE


@dataclass(frozen=True)
class LevelPolicy:
    """How far one `--quality` goes."""

    size: int
    """The longer side of the photos, in pixels, at most."""
    gaussians: int
    """The most that splitting reaches."""
    seconds: tuple[float, float]
    """What the plan may take, and for each million pixels of all photos together."""
    passes: float
    """How often each photo is shown at most that is no larger than the working pictures; larger ones more often, as
    their pixels are more."""
    shared_gaussians: int
    """Splitting may reach so many whatever the photos."""
    pixels_each: float
    """It may reach one for so many pixels of all photos, as far as the time then shows each photo
    `FullSizePolicy.fewest_passes` times."""
    gaussians_per_photo: float = 0.0
    """And it may reach so many for each photo. None of the three goes beyond `gaussians`."""
    most_seconds: float = math.inf
    """However many pixels there are."""
    seconds_per_photo: float = 0.0
    """The plan may take so long for each photo, where that is more than all of the above."""
    halved: float = 0.0
    """Share of the steps that see their photo at half of its size, too, where photos are larger than the working
    pictures (`RenderingLoss.halved`)."""
    most_rounds: int = 0
    """Rounds after the stages at most; they end when the loss stops falling."""

    def planned_seconds(self, photos: int, megapixels: float) -> float:
        """For so many photos, which have so many million pixels together at the size of this level."""
        base, each_megapixel = self.seconds
        return max(min(base + each_megapixel * megapixels, self.most_seconds), self.seconds_per_photo * photos)

    def sure_gaussians(self, photos: int) -> int:
        """What splitting may reach for so many photos, however few pixels they have."""
        return int(min(self.gaussians, max(self.shared_gaussians, self.gaussians_per_photo * photos)))


@dataclass(frozen=True)
class FullSizePolicy:
    """What `--quality standard`, `high` and `max` do after the run on working pictures.

    Rates, passes and the Gaussians of `standard` were chosen on fortress, dtu106, kermit and fox at 448 pixels, the
    others by the seconds that steps take.
    """

    levels: Mapping[FullSizeLevel, LevelPolicy] = field(
        default_factory=lambda: {
            "standard": LevelPolicy(
                900,
                140_000,
                (20.0, 0.0),
                passes=20.0,
                shared_gaussians=70_000,
                pixels_each=60.0,
                seconds_per_photo=1.7,
                gaussians_per_photo=2_800.0,
            ),
            "high": LevelPolicy(
                1600,
                600_000,
                (60.0, 10.0),
                passes=50.0,
                shared_gaussians=200_000,
                pixels_each=30.0,
                most_seconds=900.0,
                halved=1 / 3,
            ),
            "max": LevelPolicy(
                WHOLE,
                1_000_000,
                (60.0, 10.0),
                passes=50.0,
                shared_gaussians=500_000,
                pixels_each=30.0,
                halved=1 / 3,
                most_rounds=8,
            ),
        }
    )
    """50 passes with dropout, instead of 14 without, take three times the seconds. Held out on grey at 448 pixels they
    bring fortress from 30.35 to 30.70 dB, dtu106 from 28.53 to 28.63, fox from 23.59 to 23.67; SSIM gains 0.004 to
    0.008. 20 instead of 14 bring 0.09 dB (docs/tried.md).

    What `standard` spends on each photo of many was chosen on fox, and the pixels for each Gaussian on fox and kermit
    (docs/tried.md).

    The seconds of `high` are 444 for 20 photos of 1,600 × 1,200, so that the whole command takes about ten
    minutes on two quiet cores."""
    learning_rate: float = 0.025
    """In Gaussian space, at the start of a stage. Held out, `high` has 0.09 dB more with 0.02 than with 0.03 (mean of
    fox and kermit), and `standard` hardly differs (docs/tried.md)."""
    ssim_weight: float = 0.4
    """Of D-SSIM = (1 − SSIM)/2 beside L1, twice that of the release. Held out, the sets that are tuned on gain 0.06 dB
    and 0.001 of SSIM on the mean, and photos that are inputs 0.2 to 0.5 dB (docs/tried.md)."""
    rate_photos: int = 12
    """Of more photos, the rate falls with the square root of their number. The more there are, the fewer of them show
    a Gaussian. Adam divides by the root mean square of all its gradients, the zeros of other photos included, so it
    would move the farther each time that it is shown (docs/tried.md)."""
    stages: tuple[tuple[float, float], ...] = ((0.5, 0.35), (1.0, 0.65))
    """Coarse to fine: the share of the photos' size, and the share of the planned seconds, of each stage."""
    later_rate: float = 0.7
    """A stage that follows a smaller one starts at this share of the rate: it goes on with what the other has fitted.
    Held out, SSIM gains 0.002 on the mean of the sets that are tuned on (docs/tried.md)."""
    least_enlargement: float = 1.3
    """Pictures that are larger than the working ones by a smaller factor are not worth a stage of their own. On fox,
    those of 480 pixels instead of 448 cost 0.25 dB."""
    splits: tuple[float, ...] = (0.05, 0.2, 0.35, 0.5)
    """Shares of the steps of a stage after which Gaussians are split. The other steps adapt them."""
    most_passes: int = 100
    """How often the plan shows each photo at most. Up to `TtoPolicy.few_views` photos have `TtoPolicy.passes`."""
    fewest_passes: float = 12.0
    """Photos are so small that the time lasts to show each of them so often."""
    dropout: float = 0.08
    """Share of the Gaussians that the last step of a stage leaves out, where the plan shows each photo often. Held out
    on kermit and fox, shown 50 times each at 448 pixels: without dropout 22.90 and 24.69 dB (SSIM 0.774, 0.827), with
    0.08 23.07 and 24.77 (0.780, 0.834), with 0.15 22.91 and 24.78 (0.777, 0.833). Shown 20 times, they lose 0.1 dB
    with 0.1."""
    dropout_passes: float = 30.0
    """A stage that shows each photo more often than this has dropout. Shown 14 to 20 times in each of two stages, all
    sets that are tuned on are better without it, by 0.11 dB and 0.0045 of SSIM on the mean (docs/tried.md)."""
    least_pixels_per_gaussian: float = 10.0
    """Pixels of all photos together for each Gaussian that splitting may reach, at least."""
    step_seconds: tuple[float, float, float] = (0.01, 0.8e-7, 0.65e-6)
    """What a step takes, for each pixel of its view, and for each Gaussian; measured on two cores. The plan counts on
    these figures and never on a clock, so that the same seed gives the same scene however busy the machine is."""
    round_passes: int = 6
    """`max` goes on in rounds that show each photo so often."""
    least_gain: float = 0.01
    """`max` ends after a round that lowers the loss on the input photos by a smaller share."""

    def rate(self, photos: int) -> float:
        """The learning rate at the start of a stage, for so many photos."""
        return self.learning_rate * min(1.0, math.sqrt(self.rate_photos / photos))


FULL_SIZE_POLICY = FullSizePolicy()
