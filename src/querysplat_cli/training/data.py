"""Training samples on disk, and the draw of the samples of each step."""

import hashlib
import json
from collections import OrderedDict
from collections.abc import Callable
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

Result = TypeVar("Result")


@dataclass(frozen=True)
class PreparedSamples:
    """Samples that are in the cache, and those that could not be made, with the reason."""

    ready: int
    failed: tuple[str, ...]


def prepare_samples(
    data: DataSettings, encoder: Callable[[], Encoder], *, rank: int = 0, world: int = 1, progress: Progress
) -> PreparedSamples:
    """Make every sample that is not in the cache yet; process `rank` of `world` makes its share.

    A sample that cannot be made leaves a .failed file with the reason, and is not tried again. `encoder` is called
    only when a sample has to be made.
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
    return PreparedSamples(sum(path.is_file() for *_, path in waiting), tuple(failed))


def cache_folder(data: DataSettings, source: SourceSettings) -> Path:
    """The folder of a source's samples. Its name depends on the encoder, the size and everything that a draw uses."""
    counted = {name: value for name, value in asdict(source).items() if name not in ("scenes", "samples")}
    content = json.dumps([data.encoder, data.max_size, counted], sort_keys=True)
    return Path(data.cache).expanduser() / f"{source.kind}-{hashlib.sha256(content.encode()).hexdigest()[:12]}"


class Samples:
    """The samples in the cache. The draw of a step depends only on the seed, the step and the process."""

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
        """The sample in `path`. A background thread starts to read `following`."""
        waiting = self._ahead.pop(path, None)
        sample = waiting.result() if waiting else read_sample(path)
        if following is not None and following not in self._ahead:
            self._ahead[following] = self._reader.submit(read_sample, following)
        return sample


class RecentResults(Generic[Result]):
    """The results of a slow function for the `limit` files that were used last."""

    def __init__(self, limit: int) -> None:
        self._limit = limit
        self._results: OrderedDict[Path, Result] = OrderedDict()

    def get(self, path: Path, make: Callable[[], Result]) -> Result:
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
    except (OSError, SafetensorError, LookupError, TypeError, ValueError, RecursionError) as error:
        raise QuerySplatError(f"{path} is damaged: {error}", "Delete it, and it is made again.") from error
