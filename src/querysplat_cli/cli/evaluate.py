"""`querysplat eval`: methods on one scale."""

from enum import StrEnum
from pathlib import Path
from typing import Annotated

import typer

from querysplat_cli.cli.options import (
    Device,
    Encoder,
    Force,
    Json,
    NetworkPrecision,
    Precision,
    Preset,
    Queries,
    Quiet,
    Seed,
    Weights,
    number_or_auto,
)
from querysplat_cli.runtime.errors import QuerySplatError


class ProtocolOption(StrEnum):
    release = "release"
    text = "text"


class Net(StrEnum):
    vgg = "vgg"
    alex = "alex"


def evaluate(
    scenes: Annotated[
        list[Path],
        typer.Argument(
            metavar="SCENES...", help="Scenes, zips of scenes, or folders of scenes; with --merge, results."
        ),
    ],
    output: Annotated[
        Path, typer.Option("--output", "-o", help="A folder; a run that was stopped goes on there.")
    ] = Path("evaluation"),
    splits: Annotated[
        list[Path] | None, typer.Option(help="Split files or index files, or a folder of them; generated otherwise.")
    ] = None,
    protocol: Annotated[ProtocolOption, typer.Option(help="The authors' script, or the paper's text.")] = (
        ProtocolOption.release
    ),
    views: Annotated[str, typer.Option(help="Numbers of inputs of generated splits.")] = "2,4,12",
    scales: Annotated[str, typer.Option(help="Scales of generated splits.")] = "small,medium,large",
    cases: Annotated[int | None, typer.Option(min=1, help="Cases of each split; 300 of a generated one.")] = None,
    cameras: Annotated[str, typer.Option(help="Cameras that are found, the dataset's, or both.")] = "free,posed",
    tto: Annotated[str, typer.Option(metavar="STEPS,...", help="Rows by steps of test-time optimisation.")] = "0,20,50",
    sweep: Annotated[
        list[str] | None,
        typer.Option(
            metavar="FIELD=VALUE,...", help="Rows by any setting of `reconstruct`; may be repeated; draws curves."
        ),
    ] = None,
    predictions: Annotated[Path | None, typer.Option(help="Score another method's outputs instead.")] = None,
    name: Annotated[str | None, typer.Option(help="What --predictions are called in the tables.")] = None,
    max_size: Annotated[
        int | None, typer.Option(min=96, help="Longer side that is worked at; the protocol's by default.")
    ] = None,
    queries: Queries = "auto",
    preset: Preset = "compact",
    encoder: Encoder = None,
    weights: Weights = None,
    precision: Precision = NetworkPrecision.fp32,
    pictures: Annotated[
        str, typer.Option(help="The folder of pictures to take where a scene has several.")
    ] = "images_4",
    lpips: Annotated[Path | None, typer.Option(help="A folder with LPIPS weights; see docs/cli.md.")] = None,
    lpips_net: Annotated[Net, typer.Option(help="LPIPS's backbone.")] = Net.vgg,
    save_pictures: Annotated[bool, typer.Option(help="Keep the scored renders.")] = False,
    splits_only: Annotated[bool, typer.Option(help="Write the splits, and stop.")] = False,
    shard: Annotated[str, typer.Option(metavar="I/N", help="Run only the I-th of N parts of the cases.")] = "1/1",
    merge: Annotated[bool, typer.Option(help="Join the results of shards instead of running anything.")] = False,
    workers: Annotated[int, typer.Option(min=1, help="Cases side by side, each in a process.")] = 1,
    device: Device = "auto",
    seed: Seed = 42,
    force: Force = False,
    quiet: Quiet = False,
    json: Json = False,
) -> None:
    """Score scenes by the paper's protocol: input, interpolation and extrapolation views, apart."""
    numbers = tuple(_whole(part, "--views") for part in views.split(","))
    limit, sources, part = number_or_auto(1)(queries), _chosen("--cameras", cameras, ("free", "posed")), _shard(shard)
    from querysplat_cli.cli.console import console, print_evaluation, showing_stages
    from querysplat_cli.evaluation.generate import INTERVALS, SCALES
    from querysplat_cli.evaluation.grid import read_axis
    from querysplat_cli.evaluation.plan import EvalRequest
    from querysplat_cli.evaluation.protocol import Protocol
    from querysplat_cli.evaluation.results import merge as merge_results
    from querysplat_cli.evaluation.run import evaluate as run
    from querysplat_cli.evaluation.summary import summarise
    from querysplat_cli.evaluation.sweep import write_curves
    from querysplat_cli.pipeline.settings import ReconstructSettings

    if merge:
        merge_results(scenes, output)
        print_evaluation(summarise(output), output, quiet=quiet, as_json=json)
        return
    if unknown := set(numbers) - INTERVALS.keys():
        raise QuerySplatError(f"--views {unknown.pop()}: splits have {', '.join(map(str, INTERVALS))} inputs")
    rules = Protocol(protocol.value)
    settings = ReconstructSettings(
        inputs=(),
        ply=Path("scene.ply"),
        queries=limit,
        max_size=max_size,
        fit="pad",  # the protocol has cut the photos where it wants to
        preset=preset,
        encoder=encoder,
        weights=weights,
        precision=precision.value,
        device=device,
        seed=seed,
    )
    request = EvalRequest(
        scenes=tuple(scenes),
        out=output,
        splits=tuple(splits or ()),
        views=numbers,
        scales=_chosen("--scales", scales, SCALES),
        cases=cases,
        protocol=rules,
        cameras=sources,  # type: ignore[arg-type]  # two of the names above
        axes=tuple(read_axis(text) for text in (sweep or [f"tto={tto}"])),
        settings=settings,
        predictions=predictions,
        name=name,
        lpips=lpips,
        lpips_net=lpips_net.value,
        pictures=pictures,
        save_pictures=save_pictures,
        shard=part,
        workers=workers,
        splits_only=splits_only,
        force=force,
    )
    with showing_stages(quiet=quiet) as stages:
        summary = run(request, stages, (lambda text: None) if quiet else console.print)
    print_evaluation(summary, output, quiet=quiet, as_json=json)
    if sweep and not splits_only:
        write_curves(output)


def _whole(text: str, option: str) -> int:
    if not text.strip().isdecimal():
        raise QuerySplatError(f"{option} {text}: not a whole number", "Separate numbers by commas.")
    return int(text)


def _chosen(option: str, text: str, known: tuple[str, ...]) -> tuple[str, ...]:
    parts = tuple(dict.fromkeys(part.strip() for part in text.split(",")))
    if unknown := [part for part in parts if part not in known]:
        raise QuerySplatError(f"{option} {unknown[0]}: no such choice", f"Choose from {', '.join(known)}.")
    return parts


def _shard(text: str) -> tuple[int, int]:
    number, _, of = text.partition("/")
    if not (number.isdecimal() and of.isdecimal() and 1 <= int(number) <= int(of)):
        raise QuerySplatError(f"--shard {text}: not I/N with I from 1 to N", "For instance 2/8.")
    return int(number), int(of)
