"""The encoder `vggt_omega`."""

from querysplat_cli.encoders.base import EncoderOptions
from querysplat_cli.encoders.transformer.feedforward import FeedForwardEncoder
from querysplat_cli.encoders.vggt_omega.model import CONFIG, VggtOmega


def make(options: EncoderOptions) -> FeedForwardEncoder:
    return FeedForwardEncoder("vggt_omega", VggtOmega, CONFIG, options)
