"""Training samples in the cache, and the draw of the samples of each step."""

import hashlib
import json
from collections import OrderedDict
from collections.abc import Callable, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Generic, Protocol, TypeVar, runtime_checkable

import numpy as np

from querysplat_cli.encoders.base import Encoder
from querysplat_cli.runtime.engine import Engine, InProcess
from querysplat_cli.runtime.errors import MissingPart, QuerySplatError
from querysplat_cli.runtime.progress import Progress
from querysplat_cli.runtime.words import counted
from querysplat_cli.scene.files import atomic_path
from querysplat_cli.training.config import DataSettings, SourceSettings, StageSettings
from querysplat_cli.training.passes import Sample, make_sample, read_sample, write_sample
from querysplat_cli.training.sources import open_source, walked_once

Result = TypeVar("Result")


IN_PROCESS = InProcess()


@dataclass(frozen=True)
class PreparedSamples:
    """Samples that are in the cache, and those that could not be made, with the reason."""

    ready: int
    failed: tuple[str, ...]


@dataclass(frozen=True)
class Wanted:
    """A sample that belongs to the data, made or not: draw `draw` of scene `scene` of source `source`, and its file."""

    source: int
    scene: int
    draw: int
    path: Path

    @property
    def reason(self) -> Path:
        """The file that says why the sample cannot be made."""
        return self.path.with_suffix(".failed")


def wanted_samples(data: DataSettings, sources: Sequence[SourceSettings]) -> list[Wanted]:
    """Every sample of these sources, in order. Raises QuerySplatError when a source is missing."""
    return [
        Wanted(number, scene, draw, folder / f"{source.name(scene)}-{draw:03d}.safetensors")
        for number, settings in enumerate(sources)
        for folder, source in [(cache_folder(data, settings), open_source(settings))]
        for scene in range(len(source))
        for draw in range(settings.samples)
    ]


def prepare_samples(
    data: DataSettings,
    encoder: Callable[[], Encoder],
    *,
    rank: int = 0,
    world: int = 1,
    wait: Callable[[], None] = lambda: None,
    engine: Engine = IN_PROCESS,
    progress: Progress,
) -> PreparedSamples:
    """Make every sample that is not in the cache yet; process `rank` of `world` makes its share.

    `wait` returns once all processes have made theirs: the result counts these, too. `engine` does the work. A sample
    that cannot be made leaves a .failed file with the reason, and is not tried again. Raises QuerySplatError, once all
    others are made, for samples whose process ended; those are tried again. `encoder` is called only when a sample has
    to be made, once in each worker; it can be pickled where there are several.
    """
    every = wanted_samples(data, data.sources)
    share = [each for number, each in enumerate(every) if number % world == rank]
    missing = [each for each in share if not each.path.is_file() and not each.reason.is_file()]
    done = len(share) - len(missing)
    lost: list[str] = []

    def made(job: Wanted, why: str | None) -> None:
        nonlocal done
        done += 1
        if why:
            lost.append(f"{job.path.stem}: {why}")
        progress(f"{done} of {len(share)} samples", done / len(share))

    if missing:
        engine.run(sample_maker, (data, encoder), missing, made)
    if lost:
        raise QuerySplatError(
            f"{counted(len(lost), 'sample')} could not be made, as {lost[0]}", "The same command makes what is missing."
        )
    wait()
    failed = tuple(f"{each.path.stem}: {each.reason.read_text()}" for each in every if each.reason.is_file())
    return PreparedSamples(sum(each.path.is_file() for each in every), failed)


@walked_once()
def sample_maker(setup: tuple[DataSettings, Callable[[], Encoder]]) -> Callable[[Wanted], None]:
    """A function that makes a sample of the data with the encoder, or writes the reason why it cannot be made."""
    data, encoder = setup[0], setup[1]()
    sources = [open_source(settings) for settings in data.sources]

    def make(job: Wanted) -> None:
        settings = data.sources[job.source]
        try:
            shot = sources[job.source].capture(job.scene, job.draw)
            sample = make_sample(shot, encoder, max_size=data.max_size, seed=settings.seed)
        except MissingPart:  # no fault of the sample
            raise
        except QuerySplatError as error:
            with atomic_path(job.reason) as draft:
                draft.write_text(error.message)
        else:
            write_sample(job.path, sample)

    return make


def cache_folder(data: DataSettings, source: SourceSettings) -> Path:
    """The folder of a source's samples. Its name depends on all that a sample does.

    These are the encoder, the folder of its weights, the size, and everything that a draw uses.
    """
    counted = {name: value for name, value in asdict(source).items() if name not in ("scenes", "samples")}
    if not source.varied:
        del counted["varied"]  # so that caches from before there were varied scenes are found
    # Without weights the name is that of caches from before they counted.
    weights = [str(Path(data.weights).expanduser().resolve())] if data.weights else []
    content = json.dumps([data.encoder, data.max_size, counted, *weights], sort_keys=True)
    return Path(data.cache).expanduser() / f"{source.kind}-{hashlib.sha256(content.encode()).hexdigest()[:12]}"


@dataclass(frozen=True)
class Draw:
    """Sample `index` of the batch of a step, with `inputs` (fewest, most) inputs."""

    step: int
    index: int
    inputs: tuple[int, int]


@runtime_checkable
class Samples(Protocol):
    """Where the samples of each step come from. A draw gives the same one every time, in every process.

    `redrawn` counts scenes that gave no sample, so that another was drawn in their place.
    """

    redrawn: int

    def get(self, draw: Draw, following: Draw | None = None) -> tuple[Sample, Path | None]:
        """The sample of a draw, and its file if it has one. The preparation of `following` may begin already.

        Raises QuerySplatError when there is none.
        """
        ...


class CachedSamples:
    """The samples in the cache. Each stage draws from those that were made for its numbers of inputs."""

    redrawn = 0

    def __init__(self, data: DataSettings, seed: int) -> None:
        self._data, self._seed = data, seed
        self._paths: dict[tuple[int, int], list[Path]] = {}
        self._reader = ThreadPoolExecutor(1)
        self._ahead: dict[Path, Future[Sample]] = {}

    def paths(self, inputs: tuple[int, int]) -> list[Path]:
        """The files of a stage with so many inputs."""
        if inputs not in self._paths:
            every = wanted_samples(self._data, narrowed(self._data.sources, inputs))
            self._paths[inputs] = [each.path for each in every if each.path.is_file()]
        return self._paths[inputs]

    def path(self, draw: Draw) -> Path:
        """The file of a draw; raises QuerySplatError when the stage has no sample."""
        fitting = self.paths(draw.inputs)
        if not fitting:
            raise no_samples(self._data, draw.inputs)
        chance = np.random.default_rng([self._seed, draw.step, draw.index])
        return fitting[int(chance.integers(len(fitting)))]

    def get(self, draw: Draw, following: Draw | None = None) -> tuple[Sample, Path | None]:
        path = self.path(draw)
        waiting = self._ahead.pop(path, None)
        sample = waiting.result() if waiting else read_sample(path)
        ahead = None if following is None else self.path(following)
        if ahead is not None and ahead not in self._ahead:
            self._ahead[ahead] = self._reader.submit(read_sample, ahead)
        return sample, path


def narrowed(sources: Sequence[SourceSettings], inputs: tuple[int, int]) -> list[SourceSettings]:
    """The sources with only the numbers of inputs that lie in `inputs`; without those that have none."""
    found = []
    for source in sources:
        both = max(source.inputs[0], inputs[0]), min(source.inputs[1], inputs[1])
        if both[0] <= both[1]:
            found.append(replace(source, inputs=both))
    return found


def sources_of_stages(data: DataSettings, stages: Sequence[StageSettings]) -> list[SourceSettings]:
    """Every source as the stages draw from it, each once."""
    found = (source for stage in stages for source in narrowed(data.sources, stage.inputs))
    return list(dict.fromkeys(found))


def no_samples(data: DataSettings, inputs: tuple[int, int]) -> QuerySplatError:
    if not narrowed(data.sources, inputs):
        return QuerySplatError(
            f"no source has samples of {inputs[0]} to {inputs[1]} inputs",
            "Change stages.inputs or data.sources.inputs.",
        )
    return QuerySplatError(
        f"{data.cache}: no samples could be made of the sources", "See the .failed files there for the reasons."
    )


class RecentResults(Generic[Result]):
    """The results of a slow function for the `limit` files that were used last."""

    def __init__(self, limit: int) -> None:
        self._limit = limit
        self._results: OrderedDict[Path, Result] = OrderedDict()

    def get(self, path: Path | None, make: Callable[[], Result]) -> Result:
        """The result for a file. What has no file is made anew."""
        if path is None:
            return make()
        if path not in self._results:
            self._results[path] = make()
            if len(self._results) > self._limit:
                self._results.popitem(last=False)
        self._results.move_to_end(path)
        return self._results[path]
