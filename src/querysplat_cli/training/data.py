"""Training samples on disk, and which of them a step sees."""

import hashlib
import json
from collections import OrderedDict
from collections.abc import Callable, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Generic, TypeVar

import numpy as np
from safetensors import SafetensorError, safe_open

from querysplat_cli.encoders.base import Encoder
from querysplat_cli.runtime.errors import ImpossibleScene, QuerySplatError
from querysplat_cli.runtime.progress import Progress
from querysplat_cli.scene.files import atomic_path
from querysplat_cli.training.config import DataSettings, SourceSettings
from querysplat_cli.training.passes import Sample, make_sample, read_sample, write_sample
from querysplat_cli.training.sources import open_source

T = TypeVar("T")


@dataclass(frozen=True)
class Prepared:
    """What a preparation did: samples in the cache, and those that could not be made, with the reason."""

    ready: int
    failed: tuple[str, ...]


def prepare_samples(
    data: DataSettings, encoder: Callable[[], Encoder], *, rank: int = 0, world: int = 1, progress: Progress
) -> Prepared:
    """Make every sample that is not in the cache yet; process `rank` of `world` makes its share.

    A sample that cannot be made is prepared as such. `encoder` is called when there is something to do.
    """
    waiting, failed = [], []
    for settings in data.sources:
        source, folder = open_source(settings), cache_folder(data, settings)
        for scene in range(len(source)):
            for draw in range(settings.samples):
                waiting.append((settings, source, scene, draw, folder / f"{scene:06d}-{draw:03d}.safetensors"))
    made: Encoder | None = None
    for number, (settings, source, scene, draw, path) in enumerate(waiting):
        reason = path.with_suffix(".failed")
        if number % world == rank and not path.is_file() and not reason.is_file():
            made = made or encoder()
            progress(f"{number + 1} of {len(waiting)} samples", number / len(waiting))
            try:
                shot = source.capture(scene, draw)
                sample = make_sample(
                    shot.photos, shot.inputs, made, known=shot.known, max_size=data.max_size, seed=settings.seed
                )
                write_sample(path, sample)
            except (ImpossibleScene, QuerySplatError) as error:
                with atomic_path(reason) as draft:
                    draft.write_text(error.message)
        if reason.is_file():
            failed.append(f"{reason.stem}: {reason.read_text()}")
    return Prepared(sum(path.is_file() for *_, path in waiting), tuple(failed))


def cache_folder(data: DataSettings, source: SourceSettings) -> Path:
    """Where the samples of a source lie: another encoder, size or drawing makes other samples."""
    counted = {name: value for name, value in asdict(source).items() if name not in ("scenes", "samples")}
    told = json.dumps([data.encoder, data.max_size, counted], sort_keys=True)
    return Path(data.cache).expanduser() / f"{source.kind}-{hashlib.sha256(told.encode()).hexdigest()[:12]}"


class Samples:
    """The samples in the cache. What a step of a process draws depends on the seed, the step and the process alone."""

    def __init__(self, data: DataSettings, seed: int) -> None:
        """Raises QuerySplatError when there is no sample."""
        self._seed = seed
        found = [
            path
            for source in data.sources
            for path in sorted(cache_folder(data, source).glob("*.safetensors"))
            if int(path.stem[:6]) < source.scenes or source.kind == "captured"
        ]
        self._paths = [(path, _inputs(path)) for path in found]
        if not self._paths:
            raise QuerySplatError(
                f"{data.cache}: no samples could be made of the sources", "See the .failed files there for the reasons."
            )
        self._reader = ThreadPoolExecutor(1)
        self._ahead: dict[Path, Future[Sample]] = {}

    def __len__(self) -> int:
        return len(self._paths)

    def path(self, step: int, number: int, rank: int, inputs: tuple[int, int]) -> Path:
        """The file that sample `number` of a step comes from.

        Raises QuerySplatError when no sample has between inputs[0] and inputs[1] inputs.
        """
        fitting = [path for path, count in self._paths if inputs[0] <= count <= inputs[1]]
        if not fitting:
            raise QuerySplatError(
                f"no sample has {inputs[0]} to {inputs[1]} inputs", "Change stages.inputs or data.sources.inputs."
            )
        chance = np.random.default_rng([self._seed, step, number, rank])
        return fitting[int(chance.integers(len(fitting)))]

    def read(self, path: Path, following: Path | None = None) -> Sample:
        """A sample; `following` is read meanwhile, in the background."""
        waiting = self._ahead.pop(path, None)
        sample = waiting.result() if waiting else read_sample(path)
        if following is not None and following not in self._ahead:
            self._ahead[following] = self._reader.submit(read_sample, following)
        return sample


class Kept(Generic[T]):
    """The latest results of something slow, by file."""

    def __init__(self, limit: int) -> None:
        self._limit = limit
        self._results: OrderedDict[Path, T] = OrderedDict()

    def get(self, path: Path, make: Callable[[], T]) -> T:
        if path not in self._results:
            self._results[path] = make()
            if len(self._results) > self._limit:
                self._results.popitem(last=False)
        self._results.move_to_end(path)
        return self._results[path]


def _inputs(path: Path) -> int:
    try:
        with safe_open(path, framework="pt") as file:
            return len(json.loads(file.metadata()["sample"])["names"][0])
    except (OSError, SafetensorError, KeyError, TypeError, ValueError) as error:
        raise QuerySplatError(f"{path} is damaged: {error}", "Delete it, and it is made again.") from error


def sources_of(data: DataSettings) -> Sequence[str]:
    """What the sources are, in words."""
    return [
        f"{source.scenes} procedural scenes" if source.kind == "procedural" else ", ".join(source.places)
        for source in data.sources
    ]
