"""What `querysplat reconstruct` can be asked for."""

from dataclasses import dataclass
from pathlib import Path

from querysplat_cli.runtime.choices import Amount, CameraSource, Fit, Space, Target


@dataclass(frozen=True)
class ReconstructSettings:
    """What `querysplat reconstruct` can be asked for; see docs/cli.md. None means auto, or no limit."""

    inputs: tuple[Path, ...]
    ply: Path
    holdout_every: int | None = None
    holdout_cameras: CameraSource = "isolated"
    tto: int | None = None
    tto_target: Target = "kv"
    tto_space: Space = "features"
    queries: int | None = None
    max_size: int | None = None
    max_views: int | None = None
    fit: Fit = "crop"
    preset: str = "compact"
    encoder: str | None = None
    weights: Path | None = None
    precision: str = "fp32"
    depth: bool = False
    poses: Path | None = None
    device: str = "auto"
    seed: int = 42
    force: bool = False
    prune: Amount = "auto"
    keep_everything: bool = False
    budget: float | None = None
    refine_cameras: bool | None = None
