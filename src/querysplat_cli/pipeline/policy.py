"""Defaults of the pipeline: when cameras are refined, and how memory and time are planned."""

from dataclasses import dataclass


@dataclass(frozen=True)
class PipelinePolicy:
    """Thresholds and estimates of the pipeline.

    The values up to version 0.1 were chosen on the six sets of docs/benchmarks.md. New ones are chosen on fortress,
    dtu106, kermit and fox alone.
    """

    refine_above_px: float = 0.5
    """Cameras are refined by default where the median distance of a match from its epipolar line is larger, in pixels.
    Structure from motion leaves at most 0.24 on the six sets; known cameras that are rotated by one pixel, at
    least 0.74."""
    rounded_pixels: float = 0.05
    """Where float32 moves the median Gaussian by more, in pixels of the working pictures, a warning asks for known
    cameras nearer to their origin. On fortress 0.05 pixels cost 0.2 dB, 0.2 pixels 1.3 and 0.9 pixels 3.3."""
    memory_share: float = 0.9
    """Share of the free memory that a scene may be planned to take."""
    program_bytes: int = int(0.6 * 2**30)
    """Memory that the program and its libraries take."""
    camera_seconds: float = 0.2
    """What structure from motion takes for each photo of a pass, measured on two cores. On another machine this figure
    and the next only set how the time is shared, because optimisation lasts for as long as is left."""
    pixel_seconds: float = 8e-6
    """What depth and queries take for each pixel of each view, measured on two cores."""
    write_seconds: float = 1.5
    """What scoring, previews and files take."""
    write_gaussian_seconds: float = 4e-6
    """What they take for each Gaussian."""
    encoding_share: float = 0.4
    """Share of the time that cameras, depth and queries may take. Working pictures become smaller to stay within it."""
    full_size_share: float = 0.8
    """Share of the time left after the optimisation on working pictures that steps on large photos may take. The rest
    is for reading and scoring the photos at that size."""
    first_sight_azimuth: float = 135.0
    """Where the photos were taken from in the files of a scene: degrees from +x towards +z. From there the viewer of
    SuperSplat looks when it frames a scene by its box."""
    first_sight_distance: float = 3.0
    """The median distance of the cameras from the origin, in units of the files. Viewers that do not frame a scene
    start about so far from it."""
    least_full_size_seconds: float = 4.0
    """With less time, the scene is not taken to large photos."""
    pixel_bytes: int = 2**29
    """Bytes of the photos' pixels that stay in memory, about 90 photos of 1,600 pixels. The rest lies in a file."""
    long_run_photos: int = 60
    """From so many photos on, what a run has reached is kept until it is done."""
    undivided_photos: int = 100
    """Up to so many photos make one region, where --regions is auto. A film gives at most so many frames by default."""
    region_photos: int = 60
    """More photos are divided into regions of so many at most. A region has `TtoPolicy.queries` queries, however many
    photos it has, so smaller regions show more; and larger ones of photos of 1,600 pixels take more than 4 GiB."""
    fewest_region_photos: int = 4
    """Photos of the core of a region at least."""
    region_overlap: float = 0.25
    """Photos of neighbours that a region gets, as a share of its own."""
    common_depth_unit: float = 0.04
    """The depth maps of all regions have one unit where the units of two regions differ by at most this share."""
    region_nearness: float = 1e-3
    """How close two photos of neighbouring places are that have no sparse point in common; 1 is the same photo."""
    owner_size: int = 128
    """Longer side, in pixels, of the depth maps that decide which region a place belongs to."""
    owner_depth: float = 1.1
    """A camera sees what is at most so many times as far as its depth map."""
    seam_views: int = 4
    """Pictures that are rendered of each overlap of two regions, from places between photos."""
    bad_seam_psnr: float = 15.0
    """Where the pictures of two regions differ by more (a lower PSNR, in dB), a warning says so."""
    refused_seam_psnr: float = 10.0
    """Where they differ by more than this, no scene is made of them: pictures of unrelated things differ as much."""
    lost_by_joining: float = 3.0
    """Where the joined scene shows the photos of a region by more dB worse than the region alone, a warning says so."""
    joint_passes: int = 4
    """How often the last optimisation of joined regions takes each photo."""
    joint_rate: float = 0.25
    """Its learning rate as a share of `FullSizePolicy.learning_rate`, however many photos there are."""
    joint_pixels: float = 1e8
    """Pixels of all photos up to which it takes them together: at most 1.3 GB. More are taken part by part."""
    joint_photos: int = 120
    """Photos up to which it takes them together. A step takes time for every Gaussian of its part, so that many photos
    together would take time with the square of their number."""


PIPELINE_POLICY = PipelinePolicy()
