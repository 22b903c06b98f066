"""Full-size networks with random weights, made on the device where they run.

Speed and memory do not depend on the values of weights.
"""

from collections.abc import Callable
from typing import TypeVar

from querysplat_cli.encoders.vggt_omega.model import VGGT_OMEGA_CONFIG, VggtOmega
from querysplat_cli.model.config import preset
from querysplat_cli.model.querysplat import QuerySplat
from querysplat_cli.runtime.choices import Precision
from querysplat_cli.runtime.precision import weight_dtypes
from querysplat_cli.scene.cameras import Cameras

import torch
from torch import nn

SPREAD = {"gamma": 0.1, "deconv": 0.01, "head.weight": 0.01, "queries": 0.5, "token": 0.5}
"""Standard deviation, or value of a gain, by part of the name. Others: 0.02, so that sizes stay about 1."""
Network = TypeVar("Network", bound=nn.Module)


def querysplat(precision: Precision, device: torch.device, name: str = "official-8192") -> QuerySplat:
    return randomised(lambda: QuerySplat(preset(name)), precision, device)


def vggt_omega(precision: Precision, device: torch.device) -> VggtOmega:
    model = randomised(lambda: VggtOmega(VGGT_OMEGA_CONFIG), precision, device)
    quarter = len(model.aggregator.rope_embed.periods)
    for embedding in (model.aggregator.rope_embed, model.aggregator.patch_embed.rope_embed):
        embedding.periods = 100.0 ** (torch.arange(quarter, device=device) / quarter)
    for name, buffer in model.named_buffers():
        if name.endswith("bias_mask"):
            buffer.fill_(1)
    return model


def randomised(make: Callable[[], Network], precision: Precision, device: torch.device, seed: int = 0) -> Network:
    """A frozen network with random tensors, made one tensor at a time."""
    model = without_numbers(make, precision)
    generator = torch.Generator(device).manual_seed(seed)
    for name, tensor in model.state_dict().items():
        values = torch.empty(tensor.shape, device=device)
        spread = next((value for part, value in SPREAD.items() if part in name), 0.02)
        if "norm" in name or "gamma" in name:
            values.fill_(0 if name.endswith("bias") else 1 if "norm" in name else spread)
        else:
            values.normal_(0, spread, generator=generator)
        model.load_state_dict({name: values.to(tensor.dtype)}, assign=True, strict=False)
    return model.requires_grad_(False).eval()


def without_numbers(make: Callable[[], Network], precision: Precision) -> Network:
    """Shapes and types alone, those that loading from a file gives."""
    with torch.device("meta"):
        model = make()
        for name, dtype in weight_dtypes(model, precision).items():
            if dtype == torch.bfloat16 and not name.startswith(("camera_head.", "dense_head.")):
                half = torch.empty(model.state_dict()[name].shape, dtype=dtype)
                model.load_state_dict({name: half}, assign=True, strict=False)
    return model


def photos(views: int, size: int, device: torch.device) -> torch.Tensor:
    return torch.rand(views, 3, size, size, generator=torch.Generator().manual_seed(0)).to(device)


def cameras(views: int, size: int, device: torch.device) -> Cameras:
    """Side by side, looking along z."""
    w2c = torch.eye(4).repeat(views, 1, 1)
    w2c[:, 0, 3] = torch.linspace(-0.2, 0.2, views)
    K = torch.tensor([[size, 0, size / 2], [0, size, size / 2], [0, 0, 1.0]]).repeat(views, 1, 1)
    return Cameras(w2c, K, size, size).to(device)
