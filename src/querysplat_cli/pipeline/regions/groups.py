"""Photos are divided into groups that show the same places: cores of even size, each with the photos beside it."""

from dataclasses import dataclass

import numpy as np
import torch

from querysplat_cli.encoders.base import PosedViews
from querysplat_cli.pipeline.policy import PIPELINE_POLICY
from querysplat_cli.scene.cameras import distances
from querysplat_cli.scene.sparse_points import shared_points


@dataclass(frozen=True)
class Group:
    """Row numbers of photos: `core` belongs to this group alone; `overlap` are photos of other cores beside it."""

    core: tuple[int, ...]
    overlap: tuple[int, ...]

    @property
    def rows(self) -> tuple[int, ...]:
        """All of them, the core first."""
        return (*self.core, *self.overlap)


def divide(posed: PosedViews, count: int) -> tuple[Group, ...]:
    """`count` groups, whose cores differ by at most one photo. The same photos give the same groups.

    Photos are close to one another that see the same sparse points, and where points say nothing, whose cameras are
    near. A group is cut in two where the least closeness is lost, and its parts again. To each core come the
    photos of others that see most of its points, at most `PipelinePolicy.region_overlap` of the core's number.
    """
    if count == 1:
        return (Group(tuple(range(len(posed.views))), ()),)
    close = _closeness(posed)
    cores = _parts(close, np.arange(len(posed.views)), count)
    cores.sort(key=lambda core: int(core.min()))
    return tuple(Group(tuple(sorted(core.tolist())), _beside(close, core)) for core in cores)


def _closeness(posed: PosedViews) -> np.ndarray:
    """Symmetric, from 0 to 1: the share of sparse points that two photos have in common, and a little for nearness."""
    count = len(posed.views)
    common = shared_points(posed.visibility or [torch.zeros(0, dtype=torch.int64)] * count, len(posed.points)).toarray()
    size = np.sqrt(np.maximum(1, common.diagonal()))
    shared = common / size[:, None] / size
    centres = posed.cameras.centres.double()
    apart = distances(centres, centres).numpy()
    step = np.median(np.sort(apart, axis=1)[:, min(1, count - 1)])
    near = PIPELINE_POLICY.region_nearness / (1 + apart / max(step, 1e-12))
    close = shared + near
    np.fill_diagonal(close, 0)
    return close


def _parts(close: np.ndarray, rows: np.ndarray, count: int) -> list[np.ndarray]:
    """`rows` in `count` parts of even size: along the second eigenvector of the graph's Laplacian, again and again."""
    if count == 1:
        return [rows]
    weights = close[np.ix_(rows, rows)].astype(np.float64)
    scale = 1 / np.sqrt(weights.sum(1))
    _, vectors = np.linalg.eigh(np.eye(len(rows)) - scale[:, None] * weights * scale)
    along = vectors[:, 1] * scale
    along = along if along[0] <= along[-1] else -along
    order = rows[np.argsort(along, kind="stable")]
    first = count // 2
    cut = round(len(rows) * first / count)
    return [*_parts(close, np.sort(order[:cut]), first), *_parts(close, np.sort(order[cut:]), count - first)]


def _beside(close: np.ndarray, core: np.ndarray) -> tuple[int, ...]:
    """The photos of other cores that are closest to those of this one."""
    total = close[core].sum(0)
    total[core] = -1
    most = min(len(total) - len(core), max(2, round(PIPELINE_POLICY.region_overlap * len(core))))
    best = np.argsort(-total, kind="stable")[:most]
    return tuple(sorted(best.tolist()))
