"""Colours of film frames: 8-bit sRGB from any bit depth, tone-mapped from HDR, and back."""

from functools import cache

import av
import cv2
import numpy as np

from querysplat_cli.scene.pictures import linear_of_srgb

PQ, HLG = 16, 18
"""Transfer characteristics of HDR films (ITU-T H.273)."""
UNTAGGED = 2
BT709 = 1
LIMITED = 1
"""Luma from 16 to 235, as players expect it."""
HD_HEIGHT = 720
"""Films that do not state their colour matrix have BT.709 from this height on, and BT.601 below, as players assume."""
EXACTLY = 2 | 1 << 13 | 1 << 18
"""FFmpeg's flags bilinear, full_chroma_int and accurate_rnd. Without them, colours are one to two of 255 too dark."""
WHITE_CODE = 65283
"""Of 16 bits, the code that FFmpeg makes of white."""
WHITE_NITS = 203.0
"""Luminance of white paper in HDR (ITU-R BT.2408). It becomes sRGB white, before highlights are compressed."""
PEAK_NITS = 1000.0
KNEE = 0.7
"""Linear light from which highlights are compressed, relative to white paper."""
REC2020_TO_REC709 = np.array(
    [[1.660491, -0.587641, -0.072850], [-0.124550, 1.132900, -0.008349], [-0.018151, -0.100579, 1.118730]], np.float32
)
P3_TO_REC709 = np.array(
    [[1.224940, -0.224940, 0.0], [-0.042057, 1.042057, 0.0], [-0.019638, -0.078636, 1.098274]], np.float32
)
TO_REC709 = {9: REC2020_TO_REC709, 12: P3_TO_REC709}
"""For linear light, by the film's primaries (ITU-T H.273): BT.2020 and Display P3. Others are taken for BT.709's."""
REC2020_LUMA = np.array([[0.2627, 0.6780, 0.0593]], np.float32)


def state_bt709(film: av.VideoStream) -> None:
    """State in a new film that its frames are those of `bt709_frame`. Players guess where nothing is stated."""
    codec = film.codec_context
    codec.colorspace = codec.color_primaries = codec.color_trc = BT709
    codec.color_range = LIMITED


def bt709_frame(pixels: np.ndarray) -> av.VideoFrame:
    """A film frame, yuv420p of limited range by BT.709, of 8-bit sRGB [height, width, 3]."""
    frame = av.VideoFrame.from_ndarray(np.ascontiguousarray(pixels), format="rgb24")
    return frame.reformat(format="yuv420p", dst_colorspace=BT709, dst_color_range=LIMITED, interpolation=EXACTLY)


def rgb_of(frame: av.VideoFrame, transfer: int, primaries: int = UNTAGGED) -> np.ndarray:
    """The picture as stored (not yet upright), 8-bit sRGB [height, width, 3].

    `transfer` is the film's transfer characteristic, and `primaries` are its primaries (ITU-T H.273). PQ and HLG are
    tone-mapped, and have those of BT.2020; any other transfer is shown as it is. Colours beyond sRGB are clipped.
    """
    matrix = BT709 if frame.colorspace == UNTAGGED and frame.height >= HD_HEIGHT else None
    if transfer in (PQ, HLG):
        return tone_mapped(frame.to_ndarray(format="rgb48le", src_colorspace=matrix), transfer)
    pixels = np.asarray(frame.to_ndarray(format="rgb24", src_colorspace=matrix, interpolation=EXACTLY))
    if primaries not in TO_REC709:
        return pixels
    return _srgb(cv2.transform(_light_of_srgb()[pixels], TO_REC709[primaries]))


def tone_mapped(pixels: np.ndarray, transfer: int) -> np.ndarray:
    """8-bit sRGB of 16-bit BT.2020 colours [height, width, 3] with the transfer PQ or HLG; white is `WHITE_CODE`.

    Up to `KNEE` the light is kept. Above, up to `PEAK_NITS`, it is compressed along an extended Reinhard curve
    (Reinhard et al. 2002, eq. 4) of the largest channel, so that hues are kept.
    """
    light = _linear_light(transfer)[pixels]
    if transfer == HLG:
        # BT.2100: the display's gamma of 1.2 acts on the luminance of the scene.
        luminance = np.maximum(cv2.transform(light, REC2020_LUMA), 1e-6)
        light = light * (PEAK_NITS / WHITE_NITS * luminance**0.2).reshape(*light.shape[:2], 1)
    light = np.maximum(cv2.transform(light, REC2020_TO_REC709), 0)
    largest = light.max(axis=2, keepdims=True)
    over = np.maximum(largest - KNEE, 0) / (1 - KNEE)
    most = (PEAK_NITS / WHITE_NITS - KNEE) / (1 - KNEE)
    compressed = KNEE + (1 - KNEE) * over * (1 + over / most**2) / (1 + over)
    light *= np.where(largest > KNEE, compressed / np.maximum(largest, 1e-6), 1)
    return _srgb(light)


def _srgb(light: np.ndarray) -> np.ndarray:
    """8-bit sRGB of linear light, clipped to [0, 1]."""
    return _srgb_of_light()[(light.clip(0, 1) * 4095 + 0.5).astype(np.uint16)]


@cache
def _light_of_srgb() -> np.ndarray:
    """Linear light of each 8-bit sRGB value."""
    return linear_of_srgb(np.arange(256) / 255).astype(np.float32)


@cache
def _linear_light(transfer: int) -> np.ndarray:
    """Of each 16-bit code value: for PQ light relative to white paper, for HLG the light of the scene in [0, 1]."""
    code = np.minimum(np.arange(1 << 16) / WHITE_CODE, 1)
    if transfer == PQ:
        # SMPTE ST 2084.
        power = code ** (1 / 78.84375)
        nits = 1e4 * (np.maximum(power - 0.8359375, 0) / (18.8515625 - 18.6875 * power)) ** (1 / 0.1593017578125)
        return (nits / WHITE_NITS).astype(np.float32)
    # ITU-R BT.2100, inverse OETF.
    a, b, c = 0.17883277, 0.28466892, 0.55991073
    return np.where(code <= 0.5, code**2 / 3, (np.exp((code - c) / a) + b) / 12).astype(np.float32)


@cache
def _srgb_of_light() -> np.ndarray:
    """8-bit sRGB of linear light in steps of 1 / 4095."""
    light = np.linspace(0, 1, 4096)
    code = np.where(light <= 0.0031308, 12.92 * light, 1.055 * np.maximum(light, 1e-9) ** (1 / 2.4) - 0.055)
    return (code * 255).round().astype(np.uint8)
