"""Words that a setting can be. They stand apart from the code that obeys them, so that `--help` imports no torch."""

from typing import Literal

HoldoutProtocol = Literal["isolated", "joint"]
"""Which photos the cameras of a scene with held-out photos are estimated from: the inputs alone (the paper's protocol),
or all photos."""

Target = Literal["kv", "features"]
"""What test-time optimisation changes: keys and values (the release), or the tokens that they are projected from."""

Space = Literal["features", "gaussians", "both"]
"""What test-time optimisation works on: the memories that Gaussians are decoded from, the Gaussians themselves, or
first the memories and then the Gaussians."""

Amount = Literal["auto", "off"] | int
"""How many Gaussians pruning keeps: as many as are needed, all, or at most this number."""

Quality = Literal["draft", "standard", "high", "max"]
"""How far a scene is optimised: in feature space on small pictures only (draft), or then in Gaussian space on the
photos at up to 900 pixels (standard), 1,600 pixels (high) or as large as they are (max)."""

FullSizeLevel = Literal["standard", "high", "max"]
"""The qualities that go on in Gaussian space."""

ExposureCorrection = Literal["auto", "off"]
"""Whether each photo has a colour transform. auto: where photos show the same surfaces in different colours."""

Overlays = Literal["auto", "off"]
"""Whether what lies over all photos takes part. auto: it does not. off: it is looked at as a part of the scene."""

TransientThings = Literal["auto", "off"]
"""Whether what stands before the scene in one photo takes part. auto: it does not. off: it is a part of the scene."""

FileFrame = Literal["upright", "vgm"]
"""The frame of the files of a scene. upright: as viewers expect it. vgm: that of the vision geometric model, with the
first camera at the origin."""

Fit = Literal["crop", "pad"]
"""How a photo fits a network. crop: the largest centred square. pad: the whole photo, on a canvas as wide as the widest
and as high as the highest photo."""

SpzVersion = Literal["3", "4"]
"""Versions of .spz that are written: 3 is compressed by gzip, 4 by Zstandard."""

Lens = Literal["auto", "equirectangular"]
"""What took the photos. auto: cameras with a pinhole or the lens of --poses, and panoramas that say that they are some.
equirectangular: every photo is a panorama of 360°."""

Matcher = Literal["auto", "sift", "sift-affine", "disk-lightglue", "xfeat"]
"""How the classical encoder matches photos. auto: SIFT, and for photos that it matches badly affine SIFT, and a network
where one is installed. The others are used for all photos."""

LearnedMatcherName = Literal["disk-lightglue", "xfeat"]
"""The matchers that are networks, with weights of their own; SIFT's matches are kept beside theirs."""

Frame = Literal["predicted", "first_view"]
"""The frame of a learned VGM's cameras. predicted: as the network gives them, the first one near the origin (the
release). first_view: moved so that the first one is the origin (the paper)."""

Precision = Literal["fp32", "tf32", "bf16"]
"""fp32: as the release. tf32: the same, with 10-bit mantissas inside matrix products on GPUs that have them.
bf16: matrix products and attention in bfloat16; norms, softmax, residuals, rotations and heads in float32."""

ProtocolName = Literal["release", "text"]
"""How an evaluation prepares photos and renders: as the authors' script does, or as the paper's text says."""

CameraSource = Literal["free", "posed"]
"""Where an evaluation takes the cameras from: estimated from the photos, or the data set's own."""

InputCount = Literal[2, 4, 12]
"""How many inputs a generated split of an evaluation has."""

Scale = Literal["small", "medium", "large"]
"""How far apart the inputs of a generated split are."""

FurtherMetric = Literal["flip", "ssimulacra2"]
"""Metrics of an evaluation beside PSNR, SSIM and LPIPS, from packages of their own."""
