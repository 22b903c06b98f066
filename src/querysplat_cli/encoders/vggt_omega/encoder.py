"""The encoder `vggt_omega`: VGGT-Omega behind the protocol of all encoders."""

from querysplat_cli.encoders.base import EncoderOptions
from querysplat_cli.encoders.transformer.feedforward import FeedForwardEncoder
from querysplat_cli.encoders.vggt_omega.model import VGGT_OMEGA_CONFIG, VggtOmega


def make(options: EncoderOptions) -> FeedForwardEncoder:
    return FeedForwardEncoder("vggt_omega", VggtOmega, VGGT_OMEGA_CONFIG, options)
