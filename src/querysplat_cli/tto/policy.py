"""Defaults of test-time optimisation: steps, rates, thresholds."""

from collections.abc import Mapping
from dataclasses import dataclass, field


@dataclass(frozen=True)
class TtoPolicy:
    """Rates, steps and thresholds of test-time optimisation.

    The values up to version 0.1 were chosen on the six sets of docs/benchmarks.md. New ones are chosen on fortress,
    dtu106, kermit and fox alone.
    """

    learning_rate: float = 0.02
    """Of a scene that was not optimised before."""
    resumed_learning_rate: float = 0.005
    """Of memories that were optimised before."""
    resumed_warm_up: int = 10
    """Steps over which the rate rises when optimisation resumes. Adam's first steps move every number by the same
    amount, whatever its gradient. That helps a new scene (held out, dtu106 gains 0.3 dB and fortress loses 0.1 dB) and
    makes an optimised one worse."""
    release_steps: int = 20
    """For learned queries, as in the authors' release."""
    release_learning_rate: float = 5e-3
    """For learned queries, as in the authors' release."""
    lpips: float = 0.05
    """Weight of LPIPS in the loss, where it takes part (the paper and the release)."""
    half: float = 0.5
    """Weight in the loss of views at half of their size, where they take part (docs/tried.md)."""
    smoothness: float = 2 / 448
    """In Gaussian space, weight in the loss of how rough the depth is that no other view confirms
    (`tto/smooth_depth.py`). Chosen on fortress, dtu106, kermit and fox (docs/tried.md)."""
    spilt: float = 0.1
    """Weight in the loss of the alpha beside what cut-out photos show. Chosen on fortress (docs/tried.md)."""
    guessed_opacity: float = 0.15
    """In Gaussian space, weight in the loss of the mean opacity, each by the Gaussian's share in guessed pixels, from
    the first split to the last. What one photo alone shows then has no more Gaussians than it needs, and those that no
    photo needs fade (3DGS-MCMC has the mean of all). Chosen on fortress, dtu106, kermit and fox (docs/tried.md)."""
    faint: float = 0.07
    """Opacity below which a split leaves out Gaussians of guessed pixels, and splits as many others more. They would
    take their time and colour next to nothing."""
    faint_weight: float = 0.02
    """Share of all blending weight that those have at most. The photos' loss then rises by at most 1 %; without a
    limit, by up to 18 % on dtu106. Chosen on fortress, dtu106, kermit and fox (docs/tried.md)."""
    views_per_step: int = 3
    """Views that one step renders, where there are more."""
    few_views: int = 4
    """Up to so many photos, an automatic plan bounds `passes` and optimisation may not open holes between the views.
    With so few photos, most of the space between them is seen by one photo or by none. Five photos of kermit already
    lose by these two."""
    dropout: float = 0.08
    """Share of the Gaussians that the last step leaves out between so few photos. Held out at 224 pixels, six cases
    of three photos (fox, dtu106, kermit) gain 0.03 dB and 0.003 of SSIM on the mean."""
    passes: int = 40
    """How often an automatic plan renders each of a few photos at most. More passes only fit the photos themselves."""
    fewest_steps: int = 30
    """Of an automatic plan."""
    most_steps: int = 150
    """Of an automatic plan. More steps improve held-out photos little."""
    queries: int = 10_000
    """Queries inside the photos that an automatic plan has time for: with those beyond the borders, they leave about 45
    steps in 14 seconds, and 30 in 10. Photos that would carry more are divided into larger blocks. Finer queries
    improve a scene only after more steps than that."""
    work_seconds: float = 14.0
    """What an automatic plan may take, by `decoding_seconds` and `splatting_seconds`, where no steps in Gaussian space
    follow."""
    work_seconds_before: float = 10.0
    """What it may take where they follow. The model's own rounds of feedback (`queries/refine.py`) do what the
    other steps did: the mean of the sets that are tuned on has 26.81 dB then, 26.79 with 14 seconds, and had 26.73
    with 14 seconds and without the rounds (docs/tried.md)."""
    many_views: int = 24
    """A draft of more photos has proportionally more seconds and steps, so that each is seen as often. 44 photos of fox
    have 27.2 dB held out after 51 steps, 28.9 after 102, and 30.1 after 205. Where steps in Gaussian space follow, more
    before them help nothing: 32.5 dB with 51 and 32.3 with 184."""
    decoding_seconds: tuple[float, float] = (0.045, 1.2e-6)
    """What decoding the memories takes in a step, and for each Gaussian, measured on two cores. The plan counts on
    these figures and never on a clock, so that the same seed gives the same scene however busy the machine is."""
    splatting_seconds: tuple[float, float] = (0.05, 1.55e-6)
    """What splatting three views of 448 × 336 pixels takes in a step, and for each Gaussian, measured on two cores."""
    rise: float = 4.0
    """A step is undone when the loss of its views exceeds the least loss of the same views by this factor, or by
    `largest_rise`. Views whose gradients disagree, and Adam's first steps, more than double a small loss without harm.
    On fortress, a factor of 2 undid two steps of a run that is 0.4 dB better with them."""
    largest_rise: float = 0.1
    """A step is undone when it raises the loss by more than this."""
    patience: int = 30
    """Steps undone in a row after which a run ends; the rate has then fallen by 2³⁰."""
    prune_after: float = 1 / 3
    """Share of the steps after which Gaussians are pruned. The other steps make up for those that were removed."""
    densify_after: tuple[float, ...] = (1 / 6, 1 / 3, 1 / 2)
    """Shares of the steps after which Gaussians are split. Gaussians that are split later gain too little."""
    coverage_weight: float = 0.5
    """Weight of a lost pixel in the coverage loss, relative to the photometric loss of one pixel."""
    cameras_between: int = 3
    """Cameras of the coverage loss from one input view to the next."""
    gaussian_rates: Mapping[str, float] = field(
        default_factory=lambda: {
            "moves": 2.7,
            "turns": 1.3,
            "log_scales": 2.8,
            "logits": 2.0,
            "colours": 0.5,
            "bands": 0.8,
        }
    )
    """In Gaussian space, the rate of each field of `Changes` relative to the learning rate. Colours are SH
    coefficients, of which 1 is 0.28 of a channel. Bands, which depend on the direction, can fit one view and harm
    all others, and do so where they learn faster (docs/tried.md)."""
    sampled_every: int = 20
    """In Gaussian space, steps after which it is found anew how finely the photos sample each Gaussian. Gaussians move
    little in so many steps."""
    camera_rate: float = 0.1
    """Learning rate of camera refinement, in pixels a step, before the rate falls."""


TTO_POLICY = TtoPolicy()
