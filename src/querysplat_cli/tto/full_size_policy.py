"""Defaults of the optimisation on large photos: sizes, Gaussians, time."""

from dataclasses import dataclass

from querysplat_cli.scene.photos import WHOLE


@dataclass(frozen=True)
class FullSizePolicy:
    """What `--quality high` and `--quality max` do after the run on working pictures.

    The values were chosen on kermit at 640 pixels and by the seconds that steps take, not on larger photos.
    """

    high_size: int = 1600
    """The longer side of the photos, in pixels, for `high`."""
    max_size: int = WHOLE
    """The same for `max`: as large as they are."""
    learning_rate: float = 0.01
    """In Gaussian space, at the start of a stage."""
    stages: tuple[tuple[float, float], ...] = ((0.5, 0.35), (1.0, 0.65))
    """Coarse to fine: the share of the photos' size, and the share of the planned seconds, of each stage."""
    least_enlargement: float = 1.3
    """A stage ahead of the last is left out unless its pictures are larger than the working ones by this factor."""
    splits: tuple[float, ...] = (0.05, 0.2, 0.35, 0.5)
    """Shares of the steps of a stage after which Gaussians are split. The other steps adapt them."""
    seconds: tuple[float, float] = (60.0, 10.0)
    """What the plan may take, and for each million pixels of all photos together: about 430 seconds for 20 photos of
    1,600 × 1,200, so that the whole command takes about ten minutes on two quiet cores."""
    most_seconds: float = 900.0
    """However many photos there are, for `high`."""
    most_passes: int = 100
    """How often the plan shows each photo at most. Up to `TtoPolicy.few_views` photos have `TtoPolicy.passes`."""
    passes: float = 20.0
    """How often it shows each photo that is no larger than the working pictures; larger ones more often, as their
    pixels are more. More would only fit the photos themselves: held out on grey at 480 pixels,
    fox has 31.5 dB at the start, 33.5 after 15 passes and 31.8 after 75."""
    pixels_per_gaussian: float = 28.0
    """Pixels of all photos together for each Gaussian that splitting may reach."""
    high_gaussians: int = 200_000
    """The most that splitting reaches, for `high`."""
    max_gaussians: int = 500_000
    """The same for `max`."""
    step_seconds: tuple[float, float, float] = (0.03, 1.1e-7, 1.5e-6)
    """What a step takes, for each pixel of its view, and for each Gaussian; measured on two cores. The plan counts on
    these figures and never on a clock, so that the same seed gives the same scene however busy the machine is."""
    round_passes: int = 6
    """`max` goes on in rounds that show each photo so often."""
    least_gain: float = 0.01
    """`max` ends after a round that lowers the loss on the input photos by a smaller share."""
    most_rounds: int = 8
    """`max` ends after so many rounds in any case."""


FULL_SIZE_POLICY = FullSizePolicy()
