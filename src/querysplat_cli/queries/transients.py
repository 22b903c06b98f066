"""Transients: what stands before the scene in one photo and not in the others, such as people who walk by.

A scene cannot hold them, and would show ghosts of them from everywhere (Martin-Brualla et al. 2021, NeRF in the Wild).
Other photos tell where they are. Along the ray of such a pixel they look through every place that could give it its
colour, up to a surface that they measured in another colour.
"""

from dataclasses import replace

import cv2
import numpy as np
import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from querysplat_cli.encoders.base import Geometry
from querysplat_cli.queries.compiled_transients import AGREES, CONTRADICTS, judge_pixels
from querysplat_cli.queries.policy import QUERY_POLICY
from querysplat_cli.queries.transient_policy import TRANSIENT_POLICY
from querysplat_cli.scene.cameras import NEAREST_DEPTH, Cameras, nearest_first
from querysplat_cli.scene.masks import spread
from querysplat_cli.scene.views import Views


def without(views: Views, pixels: Bool[Tensor, "views height width"]) -> Views:
    """The views, of which these pixels take no part."""
    return replace(views, masks=views.masks & ~pixels)


def find_transients(views: Views, cameras: Cameras, geometry: Geometry) -> Bool[Tensor, "views height width"]:
    """Pixels of each view that show transients. Colours of the views have to agree (`Exposures`).

    `geometry` has depth and confidence. A transient needs three other views that measured what is behind it.
    """
    assert geometry.depth is not None
    assert geometry.confidence is not None
    near = nearest_first(cameras.centres)[:, : QUERY_POLICY.compared_views + 1]
    known = geometry.depth, geometry.confidence, views.masks, _smoothed(views)
    found = torch.zeros_like(views.masks)
    for view, row in enumerate(near):
        verdicts = _verdicts(view, row[row != view], cameras, *known)
        found[view] = torch.from_numpy(_outlined(verdicts, views.picture(view), views.masks[view].numpy()))
    return found


def _smoothed(views: Views) -> Float[Tensor, "views height width 3"]:
    """Mean colours over small squares, of pixels that take part alone."""
    window = (2 * int(TRANSIENT_POLICY.smoothed * max(views.masks.shape[1:])) + 1,) * 2
    found = []
    for view, mask in enumerate(views.masks):
        part = mask[..., None].float().numpy()
        sums = cv2.blur(views.picture(view).permute(1, 2, 0).numpy() * part, window)
        found.append(torch.from_numpy(sums / np.maximum(cv2.blur(part, window), 1e-6)[..., None]))
    return torch.stack(found)


def _verdicts(
    view: int,
    others: Int[Tensor, "compared"],
    cameras: Cameras,
    depth: Float[Tensor, "views height width"],
    confidence: Float[Tensor, "views height width"],
    masks: Bool[Tensor, "views height width"],
    colours: Float[Tensor, "views height width 3"],
) -> Int[np.ndarray, "rows columns"]:
    """Verdicts on the pixels of a sparse grid of one view; 0 everywhere where it measured no depth itself."""
    policy, stride = TRANSIENT_POLICY, TRANSIENT_POLICY.stride
    shown = masks[view] & (confidence[view] > QUERY_POLICY.confident)
    sparse = slice(stride // 2, None, stride), slice(stride // 2, None, stride)
    verdicts = torch.where(masks[view] & (confidence[view] >= policy.agreeing), AGREES, 0)[sparse].to(torch.int8)
    if not shown.any():
        return verdicts.numpy()
    nearest, farthest = np.quantile(depth[view][shown].numpy(), policy.measured).tolist()
    rows, columns = (torch.arange(stride // 2, side, stride) + 0.5 for side in shown.shape)
    own, flat = cameras[[view]], torch.ones(1, len(rows), len(columns))
    origin, found = own.centres[0], verdicts.contiguous().numpy()
    rays = own.unproject(flat, columns, rows)[0] - origin
    reach = nearest / policy.nearer, farthest * policy.farther, policy.step
    limits = (
        *(NEAREST_DEPTH, policy.same_depth, policy.same_colour, policy.perhaps),
        *(float(policy.fewest_surfaces), QUERY_POLICY.confident),
    )
    given = rays, origin, colours[view][sparse], others, cameras.w2c, torch.stack(cameras.intrinsics, 1)
    ray, centre, colour, compared, w2c, lenses = (each.contiguous().numpy() for each in given)
    maps = (each.contiguous().numpy() for each in (depth, confidence, masks, colours))
    judge_pixels(found, ray, centre, reach, colour, compared, w2c, lenses, limits, *maps)
    return found


def _outlined(
    verdicts: Int[np.ndarray, "rows columns"], picture: Float[Tensor, "3 height width"], mask: Bool[np.ndarray, "h w"]
) -> Bool[np.ndarray, "h w"]:
    """The transients of one picture, to their own edges.

    Superpixels (SLIC, Achanta et al. 2012) are judged as a whole: a contradiction along an edge means that a depth was
    off by a pixel. What touches them and is contradicted here and there belongs to them: another view may have measured
    little behind a head. GrabCut (Rother et al. 2004) finds the edges.
    """
    policy = TRANSIENT_POLICY
    odd = spread(cv2.MORPH_OPEN, verdicts == CONTRADICTS, 3)  # not along an edge
    if odd.mean() < policy.covered * policy.least or not odd.any():  # too little for any superpixels
        return np.zeros(mask.shape, bool)
    pixels = np.ascontiguousarray((picture.permute(1, 2, 0) * 255).to(torch.uint8).numpy()[..., ::-1])
    side = max(round(policy.superpixel * max(mask.shape)), 2)
    superpixels = _superpixels(pixels, side)
    sparse = superpixels[policy.stride // 2 :: policy.stride, policy.stride // 2 :: policy.stride]
    count = int(superpixels.max()) + 1
    size = np.bincount(sparse.ravel(), minlength=count)
    against, agreeing = (np.bincount(sparse[chosen], minlength=count) for chosen in (odd, verdicts == AGREES))
    transient = (against > policy.pure * (against + agreeing)) & (against > policy.covered * size)
    seed = _large(transient[superpixels] & mask)
    if not seed.any():
        return seed
    near = spread(cv2.MORPH_DILATE, seed, 2 * int(policy.around * max(mask.shape)) + 1)
    doubtful = (agreeing < policy.doubtful * size) & (against > policy.touched * size)
    whole = _touching(seed, doubtful[superpixels] & mask & near)
    height, width = mask.shape
    sure = cv2.resize((verdicts == AGREES).astype(np.uint8), (width, height), interpolation=cv2.INTER_NEAREST) > 0
    found = _large(_to_its_edges(whole, ~near | ~mask | spread(cv2.MORPH_OPEN, sure, 3), pixels, side))
    return spread(cv2.MORPH_DILATE, found, 2 * policy.edge + 1) & mask


def _superpixels(pixels: np.ndarray, side: int) -> Int[np.ndarray, "height width"]:
    """The number of each pixel's superpixel, of an 8-bit BGR picture."""
    made = cv2.ximgproc.createSuperpixelSLIC(cv2.cvtColor(pixels, cv2.COLOR_BGR2LAB), cv2.ximgproc.SLICO, side)
    made.iterate()
    made.enforceLabelConnectivity()
    return np.asarray(made.getLabels())


def _large(area: Bool[np.ndarray, "height width"]) -> Bool[np.ndarray, "height width"]:
    """The connected parts of an area that are large enough."""
    _, labels, boxes, _ = cv2.connectedComponentsWithStats(area.astype(np.uint8), connectivity=8)
    return area & (boxes[:, cv2.CC_STAT_AREA] >= TRANSIENT_POLICY.least * area.size)[labels]


def _touching(
    seed: Bool[np.ndarray, "height width"], more: Bool[np.ndarray, "height width"]
) -> Bool[np.ndarray, "height width"]:
    """The connected parts of `seed` and `more` together that hold some of `seed`."""
    _, labels = cv2.connectedComponents((seed | more).astype(np.uint8), connectivity=4)
    return (seed | more) & np.isin(labels, np.unique(labels[seed]))


def _to_its_edges(
    area: Bool[np.ndarray, "height width"], outside: Bool[np.ndarray, "height width"], pixels: np.ndarray, side: int
) -> Bool[np.ndarray, "height width"]:
    """About `area`, up to edges of the 8-bit picture, and surely not `outside`; its inside is `side` / 2 pixels in."""
    if area.all():
        return area
    labels = np.full(area.shape, cv2.GC_PR_BGD, np.uint8)
    labels[outside] = cv2.GC_BGD
    labels[area] = cv2.GC_PR_FGD
    labels[spread(cv2.MORPH_ERODE, area, max(side // 2, 1))] = cv2.GC_FGD
    cv2.setRNGSeed(0)
    colours = np.zeros((1, 65)), np.zeros((1, 65))
    rounds = TRANSIENT_POLICY.rounds
    cv2.grabCut(pixels, labels, (0, 0, 0, 0), colours[0], colours[1], rounds, cv2.GC_INIT_WITH_MASK)
    return np.asarray((labels == cv2.GC_FGD) | (labels == cv2.GC_PR_FGD))
