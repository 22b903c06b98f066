"""Rounds of feedback: the scene is rendered, compared with the photos, and corrected by the model's refiner."""

from collections import deque
from collections.abc import Iterator
from dataclasses import dataclass, replace

import torch
from jaxtyping import Float, Int
from scipy.spatial import cKDTree
from torch import Tensor

from querysplat_cli.encoders.base import Geometry
from querysplat_cli.model.anchors import Anchors, Reading
from querysplat_cli.model.config import GEOMETRY_CHANNELS
from querysplat_cli.model.heads import assemble_anchored
from querysplat_cli.model.memories import Memories
from querysplat_cli.model.querysplat import QuerySplat
from querysplat_cli.queries.evidence import Surroundings, gather_evidence
from querysplat_cli.queries.policy import QUERY_POLICY
from querysplat_cli.queries.rendering_error import compare
from querysplat_cli.runtime.device import to_device
from querysplat_cli.scene.cameras import Cameras
from querysplat_cli.scene.gaussians import Gaussians
from querysplat_cli.scene.views import Views


@dataclass(frozen=True)
class Round:
    """What the rounds so far add to the raw numbers, the scene that they make, and what the last one read."""

    refinement: Float[Tensor, "queries gaussians raw"]
    scene: Gaussians
    reading: Reading


def refined(
    model: QuerySplat, memories: Memories, anchors: Anchors, views: Views, cameras: Cameras, geometry: Geometry
) -> Anchors:
    """The same anchors with the sum of all rounds as their `refinement`, and the last `reading`, on the CPU.

    A model without rounds leaves them as they are.
    """
    device = next(model.parameters()).device
    moved = to_device((memories, anchors, views, cameras, replace(geometry, features=())), device)
    with torch.no_grad():
        last = deque(refinements(model, *moved), maxlen=1)
    if not last:
        return anchors
    refinement, read = to_device((last[0].refinement, last[0].reading), torch.device("cpu"))
    reading = Reading(read.views.int(), read.geometry.half(), read.appearance.half())
    return replace(anchors, refinement=refinement, reading=reading)


def refinements(
    model: QuerySplat, memories: Memories, anchors: Anchors, views: Views, cameras: Cameras, geometry: Geometry
) -> Iterator[Round]:
    """The rounds of the model, one after another.

    Gradients reach the weights through the last round alone: each reads the scene of the one before as it is. Where
    the caller computes in a lower precision, the model alone does: scenes and what is read of them are float32.
    """
    if not model.config.refinement_rounds:
        return
    assert geometry.depth is not None
    assert geometry.confidence is not None
    queries, per_query = anchors.opacities.shape
    around = Surroundings(views, cameras, geometry.depth, geometry.confidence, _nearest_queries(anchors))
    with torch.no_grad():
        start = torch.cat(model.anchored_raw(memories, anchors), 1).float().unflatten(0, (queries, per_query))
    total, tokens = torch.zeros_like(start), None
    for _ in range(model.config.refinement_rounds):
        before = start + total
        with torch.no_grad(), torch.autocast(start.device.type, enabled=False):
            scene = _scene(before, anchors, model)
            comparison = compare(scene, views, cameras, QUERY_POLICY.refining_grey)
            # Each head's numbers follow one another, query by query.
            halves = before[..., :GEOMETRY_CHANNELS].flatten(1), before[..., GEOMETRY_CHANNELS:].flatten(1)
            evidence = gather_evidence(anchors, scene, torch.cat(halves, 1), comparison, around)
        found = model.refiner(evidence, tokens)
        changes = [part.unflatten(1, (per_query, -1)) for part in (found.geometry, found.appearance)]
        after = total + torch.cat(changes, 2).float()
        yield Round(after, _scene(start + after, anchors, model), found.reading)
        total, tokens = after.detach(), found.tokens.detach()


def _scene(raw: Float[Tensor, "queries gaussians raw"], anchors: Anchors, model: QuerySplat) -> Gaussians:
    flat = raw.flatten(0, 1)
    return assemble_anchored(flat[:, :GEOMETRY_CHANNELS], flat[:, GEOMETRY_CHANNELS:], anchors, model.config)


def _nearest_queries(anchors: Anchors) -> Int[Tensor, "queries near"]:
    """The nearest other queries of each; itself where there are too few."""
    centres = anchors.means[:, anchors.means.shape[1] // 2].double().cpu().numpy()
    near = cKDTree(centres).query(centres, k=QUERY_POLICY.refining_neighbours + 1)[1][:, 1:]
    found = torch.from_numpy(near)
    itself = torch.arange(len(found))[:, None]
    return found.where(found < len(found), itself).to(anchors.means.device)
