"""The encoder `vggt`: VGGT behind the protocol of all encoders."""

from querysplat_cli.encoders.base import EncoderOptions
from querysplat_cli.encoders.transformer.feedforward import FeedForwardEncoder
from querysplat_cli.encoders.vggt.model import VGGT_CONFIG, Vggt


def make(options: EncoderOptions) -> FeedForwardEncoder:
    return FeedForwardEncoder("vggt", Vggt, VGGT_CONFIG, options)
