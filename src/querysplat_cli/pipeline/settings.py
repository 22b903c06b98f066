"""What `querysplat reconstruct` can be asked for. Every option is declared here, and only here."""

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated

from annotated_types import Ge, Le

from querysplat_cli.runtime.choices import (
    ExposureCorrection,
    FileFrame,
    Fit,
    FullSizeLevel,
    HoldoutProtocol,
    Lens,
    Matcher,
    Overlays,
    Quality,
    Space,
    Target,
    TransientThings,
)
from querysplat_cli.runtime.lengths import read_scale
from querysplat_cli.runtime.options import (
    Cluster,
    Device,
    Force,
    NetworkPrecision,
    Option,
    Prune,
    Seed,
    Weights,
)

SPACE_HELP = (
    "What the optimisation works on: the memories that Gaussians are decoded from (features), the Gaussians "
    "themselves, or first the one and then the other (both)."
)
REFINE_CAMERAS = Option(
    "Correct poses and focal lengths during optimisation.", ("--refine-cameras/--no-refine-cameras",)
)


TtoLpips = Annotated[
    Path | None,
    Option(
        "A folder with LPIPS weights, for the loss of the optimisation; docs/cli.md lists the files.",
        metavar="DIR",
        default="without LPIPS; official presets: torch's hub cache",
    ),
]


@dataclass(frozen=True)
class ReconstructSettings:
    """How photos become a scene. None means that the program chooses, or that there is no limit."""

    inputs: Annotated[
        tuple[Path, ...], Option("A folder of photos or films, or such files.", metavar="IMAGES", argument=True)
    ]
    ply: Annotated[
        Path,
        Option(
            "The scene to write: .ply, .spz, .sog or .glb. A folder of the same name goes beside it.",
            ("--output", "-o"),
            metavar="FILE.ply",
        ),
    ] = Path("scene.ply")
    holdout_every: Annotated[
        int | None,
        Ge(2),
        Option("Keep photos 0, N, 2N, … out of the scene, and score it on them.", metavar="N", default="no photo"),
    ] = None
    holdout_cameras: Annotated[
        HoldoutProtocol,
        Option(
            "With --holdout-every: estimate the cameras of the scene from the inputs alone (isolated, the paper's "
            "protocol), or from all photos at once (joint)."
        ),
    ] = "isolated"
    quality: Annotated[
        Quality,
        Option(
            "How far to go: optimise in feature space on small pictures only (draft), then in Gaussian space on the "
            "photos at up to 900 pixels (standard), 1600 pixels (high, about 10 minutes for 20 photos), or their own "
            "size for as long as it pays (max)."
        ),
    ] = "standard"
    tto: Annotated[
        int | None,
        Ge(0),
        Option("Steps of test-time optimisation. 0 leaves it out.", metavar="STEPS|auto", auto=True),
    ] = None
    tto_target: Annotated[
        Target,
        Option("What the optimisation changes: keys and values, or the features that they are projected from."),
    ] = "kv"
    tto_space: Annotated[
        Space,
        Option(SPACE_HELP),
    ] = "features"
    queries: Annotated[
        int | None,
        Ge(1),
        Option("The most queries to use. Of learned queries these are the first N.", metavar="N|auto", auto=True),
    ] = None
    film_frames: Annotated[
        int | None,
        Ge(1),
        Option(
            "The most frames to take of films, all films together. auto takes one whenever the picture has moved by a "
            "twelfth of its longer side, 24 to 100 in all.",
            ("--frames",),
            metavar="N|auto",
            auto=True,
        ),
    ] = None
    max_size: Annotated[
        int | None,
        Ge(96),
        Option(
            "The longer side of the working pictures, in pixels. auto is the encoder's own size; "
            "in `eval`, that of the photos that are shown.",
            metavar="PX|auto",
            auto=True,
        ),
    ] = None
    max_views: Annotated[
        int | None,
        Ge(1),
        Option(
            "The most photos to use, evenly spaced. auto is as many as memory holds with the encoders vggt and "
            "vggt_omega, and all with classical.",
            metavar="N|auto",
            auto=True,
        ),
    ] = None
    regions: Annotated[
        int | None,
        Ge(1),
        Option(
            "Divide the photos into N overlapping groups, make a scene of each, and join the scenes. auto divides more "
            "than 100 photos, into regions of at most 60.",
            metavar="N|auto",
            auto=True,
        ),
    ] = None
    cluster: Cluster = None
    fit: Annotated[
        Fit,
        Option("With vggt and vggt_omega: cut photos to a centred square (crop), or show them whole (pad)."),
    ] = "crop"
    preset: Annotated[str, Option("The model: the name of a preset, or a checkpoint file.", metavar="NAME|FILE")] = (
        "compact"
    )
    encoder: Annotated[
        str | None,
        Option(
            "The vision geometric model: classical, vggt, vggt_omega, or one that another package brings.",
            metavar="NAME",
            default="the preset's own",
        ),
    ] = None
    matcher: Annotated[
        Matcher,
        Option(
            "With classical: how photos are matched. auto takes SIFT, and for photos that it matches badly affine SIFT "
            "or a network (`querysplat weights` says how to install one); the others are used for all photos."
        ),
    ] = "auto"
    weights: Weights = None
    lpips: TtoLpips = None
    precision: NetworkPrecision = "fp32"
    depth: Annotated[bool, Option("Estimate depth even where the model does not need it.")] = False
    poses: Annotated[
        Path | None,
        Option(
            "Known cameras: a transforms.json, LLFF's poses_bounds.npy, or the folder of a COLMAP model.",
            metavar="FILE|DIR",
            default="estimated from the photos",
        ),
    ] = None
    depth_maps: Annotated[
        Path | None,
        Option(
            "Depth maps of the photos, from LiDAR or a network: 16-bit PNG, float TIFF, .npy or COLMAP's .bin, in any "
            "unit, with the names of the photos.",
            metavar="DIR",
            default="those that --poses lists",
        ),
    ] = None
    frame: Annotated[
        FileFrame,
        Option(
            "The frame of the scene's files: upright and around the origin (upright), or the first camera's own (vgm). "
            "Scenes of --poses keep the frame of the given cameras."
        ),
    ] = "upright"
    metres_by: Annotated[
        str | None,
        Option(
            "Make the unit of the scene a metre: by gps in EXIF, by the depth of --depth-maps, or by the distance "
            "between the places of two photos, such as a.jpg,b.jpg=1.5.",
            ("--scale",),
            metavar="gps|depth|A,B=M",
            default="no metres",
            parse=read_scale,
        ),
    ] = None
    lens: Annotated[
        Lens,
        Option(
            "Which photos are panoramas of 360°, which become views of 100°. equirectangular: all of them. auto: those "
            "that say so in their XMP data."
        ),
    ] = "auto"
    device: Device = "auto"
    seed: Seed = 42
    force: Force = False
    prune: Prune = "auto"
    backdrop: Annotated[
        bool,
        Option(
            "Put far Gaussians in blurred colours of the photos behind everything, so that no hole shows the viewer's "
            "background.",
            ("--backdrop/--no-backdrop",),
        ),
    ] = True
    keep_everything: Annotated[
        bool, Option("Leave nothing out: no pruning, all photos, every query. For comparisons.")
    ] = False
    budget: Annotated[
        float | None,
        Ge(1.0),
        Le(1e8),
        Option(
            "Seconds for the whole command. Sets the picture size and the steps of optimisation.",
            metavar="SECONDS",
            default="no limit",
        ),
    ] = None
    refine_cameras: Annotated[
        bool | None,
        replace(REFINE_CAMERAS, default="where the cameras fit badly"),
    ] = None

    exposure: Annotated[
        ExposureCorrection,
        Option(
            "Give each photo a colour transform where exposure or white balance changes from photo to photo. off: the "
            "scene has to show the colours of every photo itself."
        ),
    ] = "auto"
    overlays: Annotated[
        Overlays,
        Option(
            "Leave out what stays where it is in all photos of one size: text, logos, date stamps, frames, bars, and "
            "the surroundings of a turntable. off: it takes part."
        ),
    ] = "auto"
    transients: Annotated[
        TransientThings,
        Option(
            "Leave out what stands before the scene in one photo and not in the others: people walking by, or leaves "
            "before the lens. off: it takes part."
        ),
    ] = "auto"

    @property
    def full_size(self) -> FullSizeLevel | None:
        """The quality, where it goes on in Gaussian space: high and max always, standard with an automatic plan."""
        if self.quality == "draft" or (self.quality == "standard" and (self.tto is not None or self.keep_everything)):
            return None
        return self.quality

    @property
    def asks_large(self) -> bool:
        """Whether the quality names large photos, so that an encoder that cannot use them is refused."""
        return self.quality in ("high", "max")
