"""What `querysplat eval` can be asked for. Every option is declared here or in ReconstructSettings, and only there."""

from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Literal

from annotated_types import Ge

from querysplat_cli.evaluation.axes import Axis, read_axis
from querysplat_cli.pipeline.settings import ReconstructSettings
from querysplat_cli.runtime.choices import CameraSource, FurtherMetric, InputCount, ProtocolName, Scale
from querysplat_cli.runtime.errors import QuerySplatError
from querysplat_cli.runtime.json_files import shown
from querysplat_cli.runtime.options import Cluster, Force, LpipsWeights, Only, Option

WITHOUT_PHOTOS = {"inputs": (), "ply": Path("scene.ply"), "fit": "pad"}
"""The case gives the photos, the protocol cuts them, and no scene is written."""


def read_shard(text: str) -> tuple[int, int]:
    """I and N of "I/N"; raises QuerySplatError unless I is from 1 to N."""
    number, _, count = text.partition("/")
    digits = number.isdecimal() and count.isdecimal() and len(count) < 10 and len(number) < 10
    if not (digits and 1 <= int(number) <= int(count)):
        raise QuerySplatError(f"--shard {shown(text)}: not I/N with I from 1 to N", "For instance 2/8.")
    return int(number), int(count)


@dataclass(frozen=True)
class EvalRequest:
    """Scenes, the views that are scored, the rows of the table, and where the results go."""

    scenes: Annotated[
        tuple[Path, ...],
        Option(
            "Scenes, zips of scenes, or folders of scenes. With --merge: folders of results.",
            metavar="SCENES",
            argument=True,
        ),
    ]
    out: Annotated[
        Path,
        Option("A folder for the results. A run that was stopped goes on there.", ("--output", "-o"), metavar="DIR"),
    ] = Path("evaluation")
    splits: Annotated[
        tuple[Path, ...],
        Option(
            "A split file, an index file, or a folder of them. May be repeated.",
            metavar="PATH",
            default="generated",
            repeated=True,
        ),
    ] = ()
    protocol: Annotated[
        ProtocolName, Option("Prepare and score pictures as the authors' script does, or as the paper's text says.")
    ] = "release"
    views: Annotated[
        tuple[InputCount, ...], Option("The numbers of inputs of generated splits: 2, 4 or 12.", metavar="N,...")
    ] = (2, 4, 12)
    scales: Annotated[
        tuple[Scale, ...],
        Option("How far apart the inputs of generated splits are: small, medium or large.", metavar="SCALE,..."),
    ] = ("small", "medium", "large")
    cases: Annotated[
        int | None,
        Ge(1),
        Option("The most cases of each split.", metavar="N", default="all; 300 of a generated split"),
    ] = None
    cameras: Annotated[
        tuple[CameraSource, ...],
        Option("Estimate the cameras (free), take the data set's (posed), or both.", metavar="KIND,..."),
    ] = ("free", "posed")
    tto: Annotated[
        tuple[int | None, ...],
        Ge(0),
        Option("One row for each number of steps of test-time optimisation.", metavar="STEPS,...", auto=True),
    ] = (0, 20, 50)
    sweep: Annotated[
        tuple[Axis, ...],
        Option(
            "One row for each value of a setting of `reconstruct`, in place of --tto, and curves. May be repeated.",
            metavar="FIELD=VALUE,...",
            default="no sweep",
            repeated=True,
            parse=read_axis,
        ),
    ] = ()
    predictions: Annotated[
        Path | None,
        Option("Score what another method made, found in this folder.", metavar="DIR", default="QuerySplat's scenes"),
    ] = None
    name: Annotated[
        str | None, Option("The name of --predictions in the tables.", metavar="NAME", default="the folder's name")
    ] = None
    settings: Annotated[
        ReconstructSettings,
        Only(
            *("max_size", "queries", "preset", "encoder", "matcher", "weights", "precision", "device", "seed"),
            **WITHOUT_PHOTOS,
        ),
    ] = field(default_factory=lambda: ReconstructSettings(**WITHOUT_PHOTOS))  # type: ignore[arg-type]
    pictures: Annotated[str, Option("The folder of pictures to read where a scene has several.", metavar="NAME")] = (
        "images_4"
    )
    lpips: LpipsWeights = None
    lpips_net: Annotated[Literal["vgg", "alex"], Option("The backbone of LPIPS.")] = "vgg"
    metrics: Annotated[
        tuple[FurtherMetric, ...],
        Option(
            "A further metric: flip or ssimulacra2 (pip install 'querysplat[metrics]'). May be repeated.",
            default="none",
            repeated=True,
        ),
    ] = ()
    fitted: Annotated[
        bool, Option("Score targets also from cameras that are fitted to the finished scene, beside the protocol.")
    ] = False
    save_pictures: Annotated[bool, Option("Keep the renders that are scored.")] = False
    nerfbaselines: Annotated[
        bool, Option("Keep renders and photos in NerfBaselines' layout, so that others can score them again.")
    ] = False
    splits_only: Annotated[bool, Option("Write the splits, and stop.")] = False
    shard: Annotated[
        tuple[int, int] | None,
        Option("Run only the I-th of N parts of the cases.", metavar="I/N", default="all cases", parse=read_shard),
    ] = None
    merge: Annotated[bool, Option("Join the results of shards, and run nothing.")] = False
    workers: Annotated[
        int, Ge(1), Option("Cases that run at the same time, each in a process of its own.", metavar="N")
    ] = 1
    cluster: Cluster = None
    force: Force = False

    @property
    def axes(self) -> tuple[Axis, ...]:
        """The settings that differ from row to row, with their values."""
        return self.sweep or (("tto", self.tto),)
