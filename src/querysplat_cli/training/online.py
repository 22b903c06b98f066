"""Samples that are made in the step that uses them, of inputs drawn anew. They are for learned encoders."""

from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor
from pathlib import Path

import numpy as np

from querysplat_cli.encoders.base import Encoder
from querysplat_cli.runtime.errors import ImpossibleScene, QuerySplatError
from querysplat_cli.training.config import DataSettings
from querysplat_cli.training.data import Draw, narrowed, no_samples
from querysplat_cli.training.passes import Sample, make_sample
from querysplat_cli.training.policy import TRAINING_POLICY
from querysplat_cli.training.sources import Capture, Source, open_source


class OnlineSamples:
    """Every draw takes a scene, and of it inputs and targets, at random. Nothing is kept on disk.

    A scene that gives no sample is replaced by another draw.
    """

    def __init__(self, data: DataSettings, seed: int, encoder: Callable[[], Encoder]) -> None:
        self.redrawn = 0
        self._data, self._seed, self._make = data, seed, encoder
        self._encoder: Encoder | None = None
        self._sources: dict[tuple[int, int], list[Source]] = {}
        self._reader = ThreadPoolExecutor(1)
        self._ahead: dict[Draw, Future[Capture]] = {}

    def get(self, draw: Draw, following: Draw | None = None) -> tuple[Sample, Path | None]:
        """The sample of a draw; it has no file. The photos of `following` are read meanwhile.

        Raises ImpossibleScene when a policy's number of scenes gave no sample, and MissingPart without the encoder's
        weights.
        """
        self._encoder = self._encoder or self._make()
        sources, reason = self._opened(draw.inputs), ""
        waiting = self._ahead.pop(draw, None)
        # The thread casts no rays: compiled code of two threads cannot run at once.
        if following is not None and all(source.kind == "captured" for source in self._data.sources):
            self._ahead[following] = self._reader.submit(self._capture, self._opened(following.inputs), following, 0)
        for attempt in range(TRAINING_POLICY.sample_tries):
            try:
                shot = waiting.result() if waiting and not attempt else self._capture(sources, draw, attempt)
                sample = make_sample(shot, self._encoder, max_size=self._data.max_size, seed=self._seed)
            except QuerySplatError as error:
                self.redrawn += 1
                reason = error.message
            else:
                return sample, None
        raise ImpossibleScene(
            f"{TRAINING_POLICY.sample_tries} scenes in a row gave no sample; the last one: {reason}",
            "Check data.sources.",
        )

    def _opened(self, inputs: tuple[int, int]) -> list[Source]:
        if inputs not in self._sources:
            self._sources[inputs] = [open_source(each) for each in narrowed(self._data.sources, inputs)]
        if not self._sources[inputs]:
            raise no_samples(self._data, inputs)
        return self._sources[inputs]

    def _capture(self, sources: list[Source], draw: Draw, attempt: int) -> Capture:
        chance = np.random.default_rng([self._seed, draw.step, draw.index, attempt])
        scene = int(chance.integers(sum(len(source) for source in sources)))
        for source in sources:
            if scene < len(source):
                return source.capture(scene, int(chance.integers(2**31)))
            scene -= len(source)
        raise AssertionError("a scene beyond the last source")
