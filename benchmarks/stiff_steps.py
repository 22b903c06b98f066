"""Error against κ when Gaussians are optimised: needles and discs that must move, turn and change shape.

    python benchmarks/stiff_steps.py

NOTE describes the experiment. docs/stability.md holds the table.
"""

import argparse
from dataclasses import dataclass, fields, replace

from common.output import markdown
from querysplat_cli.scene.gaussians import Gaussians
from querysplat_cli.scene.tensor_dataclass import TensorDataclass
from querysplat_cli.scene.views import Views
from querysplat_cli.splat.render import render
from querysplat_cli.tto.gaussians import optimise_gaussians
from querysplat_cli.tto.optimise import TtoResult, optimise
from querysplat_cli.tto.options import TtoSettings
from querysplat_cli.tto.policy import TTO_POLICY
from querysplat_cli.tto.rendering_loss import RenderingLoss
from querysplat_cli.tto.variables import Parametrisation
from scenes import camera, cloud

import torch
from torch import Tensor
from torch.nn import functional as F

STEPS = 100
NOTE = """Sixty Gaussians whose longest axis is κ times the shortest are displaced by about a tenth of the longest axis
along every axis of the world, turned by about 20° and stretched by about a fifth. A hundred steps bring them back
to what six small pictures show. In the mixed scenes a third each have κ = 1, 10² and 10⁴. *own* is the parametrisation
of `tto/gaussians.py`. *plain* has centres in world units, linear scales and linear opacities. Both take the same rates.
Those of *plain* are in units of the longest axis, which all Gaussians share here, so that the two are alike at κ = 1.
PSNR of the pictures in dB."""
COUNT, SIZE, VIEWS, PIXELS = 60, 64, 6, 4.0
KAPPAS = (1.0, 1e2, 1e4)
SHAPES = {"needles": (1, 2), "discs": (2,)}
"""Which axes are short."""


@dataclass(frozen=True)
class Row:
    """PSNR in dB of the pictures before the steps, and after them in either parametrisation."""

    scene: str
    kappa: float
    before: float
    own: float
    plain: float


@dataclass(frozen=True)
class Plain(TensorDataclass):
    """Gaussians in their own units; only a clamp keeps a step inside their range."""

    means: Tensor
    quats: Tensor
    scales: Tensor
    opacities: Tensor
    sh: Tensor

    def gaussians(self) -> Gaussians:
        return Gaussians(
            self.means,
            F.normalize(self.quats, dim=1),
            self.scales.clamp_min(1e-12),
            self.opacities.clamp(1e-6, 1 - 1e-6),
            self.sh,
        )


def target(kappas: Tensor, short: tuple[int, ...]) -> tuple[Gaussians, float]:
    """Gaussians of one length whose `short` axes are κ times shorter, and that length in scene units."""
    cameras = camera(SIZE, SIZE, views=VIEWS)
    some = cloud(0, COUNT, cameras, opacity=(0.5, 0.9))
    length = PIXELS * 4 / float(cameras.K[0, 0, 0])
    scales = torch.full((COUNT, 3), length, dtype=torch.float64)
    scales[:, list(short)] /= kappas[:, None]
    return replace(some, quats=F.normalize(some.quats, dim=1), scales=scales).to(torch.float32), length


def disturbed(gaussians: Gaussians, length: float) -> Gaussians:
    generator = torch.Generator().manual_seed(1)

    def noise(part: Tensor) -> Tensor:
        return torch.randn(part.shape, generator=generator)

    return replace(
        gaussians,
        means=gaussians.means + 0.1 * length * noise(gaussians.means),
        quats=F.normalize(gaussians.quats + 0.1 * noise(gaussians.quats), dim=1),
        scales=gaussians.scales * torch.exp(0.2 * noise(gaussians.scales)),
    )


def plain(start: Gaussians, loss: RenderingLoss, settings: TtoSettings, length: float) -> TtoResult[Plain]:
    shipped = TTO_POLICY.gaussian_rates
    rates = {
        "means": shipped["moves"] * length,
        "quats": shipped["turns"],
        "scales": shipped["log_scales"] * length,
        "opacities": shipped["logits"] / 4,
        "sh": shipped["colours"],
    }
    variables = Plain(**{each.name: getattr(start, each.name) for each in fields(start)})
    generator = torch.Generator().manual_seed(0)
    return optimise(Parametrisation(variables, Plain.gaussians, rates), loss, settings, generator=generator)


def measure(name: str, kappas: Tensor, short: tuple[int, ...]) -> Row:
    wanted, length = target(kappas, short)
    cameras = camera(SIZE, SIZE, views=VIEWS).to(torch.float32)
    pictures = render(wanted, cameras).colour.clamp(0, 1)
    masks = torch.ones(VIEWS, SIZE, SIZE, dtype=torch.bool)
    views = Views(pictures, masks, tuple(map(str, range(VIEWS))), ((SIZE, SIZE),) * VIEWS)
    loss, start = RenderingLoss(views, cameras), disturbed(wanted, length)
    settings = TtoSettings(STEPS, TTO_POLICY.learning_rate)
    own = optimise_gaussians(start, loss, settings, generator=torch.Generator().manual_seed(0))
    other = plain(start, loss, settings, length)
    all_views = list(range(VIEWS))
    psnrs = (loss.psnr(each, all_views) for each in (start, own.gaussians, other.gaussians))
    return Row(name, float(kappas.max()), *psnrs)


def measured() -> list[Row]:
    rows = [
        measure(shape, torch.full((COUNT,), kappa, dtype=torch.float64), short)
        for shape, short in SHAPES.items()
        for kappa in KAPPAS
    ]
    mixed = torch.tensor(KAPPAS, dtype=torch.float64).repeat(COUNT // 3)
    return rows + [measure(f"{shape}, mixed", mixed, short) for shape, short in SHAPES.items()]


def table(rows: list[Row]) -> str:
    """PSNR of the pictures in dB, as Markdown."""
    cells = (
        (row.scene, f"{row.kappa:g}", *(f"{psnr:.1f}" for psnr in (row.before, row.own, row.plain))) for row in rows
    )
    return markdown(("scene", "κ", "before", "own", "plain"), cells)


if __name__ == "__main__":
    argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0]).parse_args()
    print(table(measured()))
