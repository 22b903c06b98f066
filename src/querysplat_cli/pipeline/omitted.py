"""What a run of `reconstruct` left out of the scene or of the work."""

from querysplat_cli.pipeline.build import BuiltScene
from querysplat_cli.pipeline.perceptual import optimisation_lpips
from querysplat_cli.pipeline.settings import ReconstructSettings
from querysplat_cli.prune.resolution import Blurred
from querysplat_cli.reporting import omissions
from querysplat_cli.scene.masks import MaskedShare


def omissions_of(
    settings: ReconstructSettings, scene: BuiltScene, finest: Blurred | None = None, overlaid: MaskedShare | None = None
) -> list[omissions.Omission]:
    """One entry for each part.

    `finest` is the size that holds all detail of blurred photos (None: they are sharp), `overlaid` what lies over the
    photos.
    """
    used = optimisation_lpips(settings.lpips, official=scene.prepared.anchors is None) is not None
    found = omissions.lpips(scene.adapted, used=used, further=bool(scene.full_size))
    found += omissions.of_adapted(scene.adapted)
    if scene.prepared.anchor_report and not settings.keep_everything:
        found.append(omissions.queries(scene.prepared.anchor_report, scene.adapted))
    if scene.geometry.depth is None and scene.prepared.anchors is None:  # a scene of regions keeps no depth, either
        found.append(omissions.UNUSED_DEPTH)
    if finest:
        found.append(omissions.resolution(finest))
    if overlaid:
        found.append(omissions.overlays(overlaid))
    if scene.transients:
        found.append(omissions.transients(scene.transients))
    if scene.posed.chance_pairs:
        found.append(omissions.chance_pairs(scene.posed.chance_pairs))
    if settings.poses:
        found.append(omissions.sfm(settings.poses))
    return found
