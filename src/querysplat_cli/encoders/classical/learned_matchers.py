"""Networks that find features and match them: DISK with LightGlue, and XFeat with its small LightGlue.

They match photos from places so far apart, or of things so plain, that SIFT finds too few matches. Networks and their
arithmetic are kornia's (`pip install 'querysplat[matching]'`); the weights are files that the user brings.
"""

from collections.abc import Callable
from dataclasses import dataclass
from importlib.util import find_spec
from pathlib import Path
from pickle import UnpicklingError
from typing import Any

import cv2
import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor, nn
from torch.nn import functional as F

from querysplat_cli.encoders.classical.learned_policy import LEARNED_POLICY
from querysplat_cli.runtime.choices import LearnedMatcherName
from querysplat_cli.runtime.errors import MissingPart, QuerySplatError
from querysplat_cli.runtime.matching_weights import FILES_OF, INSTALL, find_matching_weights
from querysplat_cli.scene.views import Photo


@dataclass(frozen=True)
class LearnedFeatures:
    """Features of a photo: pixels [n, 2] of a picture of `size` (height, width), centres at +0.5, and descriptors."""

    pixels: Float[Tensor, "n 2"]
    descriptors: Float[Tensor, "n channels"]
    size: tuple[int, int]

    def scaled(self, size: tuple[int, int]) -> np.ndarray:
        """The pixels [n, 2] in a picture of another (height, width)."""
        factor = [size[1] / self.size[1], size[0] / self.size[0]]
        return np.asarray(self.pixels.double().numpy() * factor)


@dataclass(frozen=True)
class LearnedMatcher:
    """A network for the features of a picture [1, 3, height, width], and one for matches.

    Both sides of the picture are multiples of `stride`.
    """

    name: LearnedMatcherName
    stride: int
    find: Callable[[Tensor], tuple[Tensor, Tensor]]
    match: nn.Module

    @torch.no_grad()
    def features(self, photo: Photo) -> LearnedFeatures:
        """The features of a photo, at the size at which the network finds most that are right."""
        height, width = photo.height, photo.width
        scale = LEARNED_POLICY.feature_size / max(height, width)
        size = [max(self.stride, round(side * scale / self.stride) * self.stride) for side in (height, width)]
        way = cv2.INTER_AREA if scale < 1 else cv2.INTER_CUBIC
        picture = cv2.resize(photo.pixels, (size[1], size[0]), interpolation=way)
        pixels, descriptors = self.find(torch.from_numpy(picture).permute(2, 0, 1)[None].float() / 255)
        return LearnedFeatures(pixels, descriptors, (size[0], size[1]))

    @torch.no_grad()
    def matches(self, one: LearnedFeatures, two: LearnedFeatures) -> np.ndarray:
        """Rows [m, 2] of the features of two photos that show the same."""
        if not (len(one.pixels) and len(two.pixels)):
            return np.zeros((0, 2), np.int64)
        found = self.match({"image0": _as_kornia(one), "image1": _as_kornia(two)})
        return np.asarray(found["matches"][0].numpy())


def find_learned_matcher(name: LearnedMatcherName, weights: Path | None) -> LearnedMatcher:
    """The matcher of this name; `weights` is a folder to look into first.

    Raises MissingPart where the library or a file is missing, and QuerySplatError where a file is damaged.
    """
    if find_spec("kornia") is None:
        raise MissingPart(f"the matcher {name} needs the library kornia", f"Run `{INSTALL}`.")
    files = [find_matching_weights(part, weights) for part in FILES_OF[name]]
    return _disk(*files) if name == "disk-lightglue" else _xfeat(*files)


def _disk(features: Path, matching: Path) -> LearnedMatcher:
    from kornia.feature import DISK

    network = _filled(DISK(), _read(features).get("extractor", {}), features)
    return LearnedMatcher("disk-lightglue", 16, lambda picture: _disk_features(network, picture), _lightglue(matching))


def _disk_features(network: Any, picture: Tensor) -> tuple[Tensor, Tensor]:
    """The largest peaks of DISK's heat map, between its pixels: the vertices of parabolas along both axes."""
    heat, descriptors = (found[0] for found in network.heatmap_and_dense_descriptors(picture))
    heat = heat[0]
    peak = (F.max_pool2d(heat[None], 5, stride=1, padding=2)[0] == heat) & (heat > 0)
    peak[0], peak[-1], peak[:, 0], peak[:, -1] = False, False, False, False
    rows = peak.nonzero()
    order = torch.argsort(heat[rows[:, 0], rows[:, 1]], descending=True, stable=True)[: LEARNED_POLICY.most_features]
    y, x = rows[order].T
    middle = heat[y, x]
    offsets = []
    for before, after in ((heat[y, x - 1], heat[y, x + 1]), (heat[y - 1, x], heat[y + 1, x])):
        bend = (2 * middle - before - after).clamp_min(1e-9)
        offsets.append(((after - before) / 2 / bend).clamp(-0.5, 0.5))
    pixels = torch.stack([x + offsets[0], y + offsets[1]], dim=1) + 0.5
    return pixels, F.normalize(descriptors[:, y, x].T, dim=1)


def _xfeat(features: Path, matching: Path) -> LearnedMatcher:
    from kornia.feature.xfeat import XFeat

    finder = XFeat(top_k=LEARNED_POLICY.most_features)
    _filled(finder.net, _read(features), features)
    small = {"input_dim": 64, "descriptor_dim": 96, "n_layers": 6, "num_heads": 1, "depth_confidence": -1}

    def find(picture: Tensor) -> tuple[Tensor, Tensor]:
        found = finder.eval().detectAndCompute(picture)[0]
        return found["keypoints"].clone() + 0.5, found["descriptors"].clone()

    return LearnedMatcher("xfeat", 32, find, _lightglue(matching, width_confidence=0.95, **small))


def _lightglue(path: Path, **settings: Any) -> nn.Module:
    """LightGlue with the weights of a file, whose older names are replaced by kornia's."""
    from kornia.feature import LightGlue

    tensors = _read(path)
    own = {name.removeprefix("matcher."): tensor for name, tensor in tensors.items() if "extractor." not in name}
    renamed = {}
    for name, tensor in own.items():
        kind, number, *rest = name.split(".")
        attention = kind in ("self_attn", "cross_attn")
        renamed[".".join(["transformers", number, kind, *rest]) if attention else name] = tensor
    usual = {"input_dim": 128, "filter_threshold": LEARNED_POLICY.least_score}
    network = LightGlue(features=None, **(usual | settings))  # type: ignore[arg-type, unused-ignore]
    return _filled(network, renamed, path)


def _read(path: Path) -> dict[str, Any]:
    """The tensors of a file, loaded so that it cannot run code."""
    try:
        found = torch.load(path, map_location="cpu", weights_only=True)
    except (OSError, RuntimeError, EOFError, UnpicklingError) as error:
        reason = str(error).splitlines()[0] if str(error) else type(error).__name__
        raise QuerySplatError(f"{path} is not a readable weight file: {reason}", f"Run `{INSTALL}`.") from error
    return dict(found) if isinstance(found, dict) else {}


def _filled(network: nn.Module, tensors: dict[str, Tensor], path: Path) -> Any:
    """The network with these tensors; others are not read. LightGlue works its thresholds out itself."""
    shapes = {name: tensor.shape for name, tensor in network.state_dict().items() if name != "confidence_thresholds"}
    if not all(name in tensors and tensors[name].shape == shape for name, shape in shapes.items()):
        raise QuerySplatError(f"{path} holds the weights of another network", f"Run `{INSTALL}`.")
    network.load_state_dict({name: tensors[name] for name in shapes}, strict=False)
    return network.eval().requires_grad_(False)


def _as_kornia(features: LearnedFeatures) -> dict[str, Tensor]:
    height, width = features.size
    size = torch.tensor([[width, height]], dtype=torch.float32)
    return {"keypoints": features.pixels[None].float(), "descriptors": features.descriptors[None], "image_size": size}
