"""The encoder `vggt`."""

from querysplat_cli.encoders.base import EncoderOptions
from querysplat_cli.encoders.transformer.feedforward import FeedForwardEncoder
from querysplat_cli.encoders.vggt.model import CONFIG, Vggt


def make(options: EncoderOptions) -> FeedForwardEncoder:
    return FeedForwardEncoder("vggt", Vggt, CONFIG, options)
