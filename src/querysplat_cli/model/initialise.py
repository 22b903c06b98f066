"""The compact model before any training: its first output is exactly the anchors' prior.

    python -m querysplat_cli.model.initialise compact.safetensors --seed 0

Values and the last layers of the MLPs start at zero, so the decoders add nothing. Attention, output projection and
heads are set so that each value channel of a memory token controls one raw number of the Gaussians near that token.
Test-time optimisation of the memories then starts well conditioned. Training does not change these parts, and starts
from the prior's scene.
"""

import argparse
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path

import torch

from querysplat_cli.model.checkpoints import save
from querysplat_cli.model.config import ModelConfig, preset
from querysplat_cli.model.decoders import DecoderBlock
from querysplat_cli.model.querysplat import QuerySplat

INITIAL_GAINS = {"centre": 6.0, "scale": 3.0, "quaternion": 4.0, "sh_0": 1.0, "sh_rest": 0.25, "opacity": 2.0}
"""Change of each raw number for a unit change of its value channel.

Chosen by held-out photos of fortress, dtu106 and kermit after 60 steps of test-time optimisation. Shape has to
change faster than colour, since otherwise colours adapt to wrong depth before depth is corrected.
"""
HEAD_SPREAD = 0.002
"""Standard deviation of the geometry head's weights before a training from scratch (the release)."""
KEY_GAIN = 0.1
"""Size of normed keys: so small that at first only distance decides what a query attends to."""


def scratch_model(config: ModelConfig, seed: int) -> QuerySplat:
    """Weights drawn as in the release, to train all of them; the same for the same seed.

    Those of the geometry head are small, and its bias is zero, so that Gaussians start at the middle of their ranges.
    """
    with _seeded(seed):
        model = QuerySplat(config)
        torch.nn.init.trunc_normal_(model.geometry_head.weight, std=HEAD_SPREAD)
        torch.nn.init.zeros_(model.geometry_head.bias)
    return model


def with_rounds(model: QuerySplat, wanted: ModelConfig, seed: int) -> QuerySplat:
    """The model with the rounds of refinement of `wanted`, which change nothing yet; the same for the same seed."""
    config = replace(model.config, refinement_rounds=wanted.refinement_rounds, refinement=wanted.refinement)
    with _seeded(seed):
        wider = QuerySplat(config)
    wider.load_state_dict({**wider.state_dict(), **model.state_dict()})
    return wider


@contextmanager
def _seeded(seed: int) -> Iterator[None]:
    """Inside, torch's random numbers are those of `seed`; outside, they go on as before."""
    with torch.random.fork_rng():
        torch.manual_seed(seed)
        yield


def initial_model(config: ModelConfig, seed: int) -> QuerySplat:
    """An anchored model whose output is the prior; the same for the same seed."""
    with _seeded(seed):
        model = QuerySplat(config)
    with torch.no_grad():
        for memory in (model.geometry_memory, model.appearance_memory):
            memory.proj.weight[config.width :] = 0
            memory.proj.bias[config.width :] = 0
            memory.k_norm.weight.fill_(KEY_GAIN)
        for decoder in (model.geometry_decoder, model.appearance_decoder):
            for i, block in enumerate(decoder.blocks):
                assert isinstance(block, DecoderBlock)
                # Only the last block reads the memory, and only the first one has an active MLP. In a decoder of two
                # blocks the MLP then does not depend on the memory, and test-time optimisation need not go through it.
                block.cross_scale.gamma.fill_(1.0 if i == len(decoder.blocks) - 1 else 0.0)
                block.self_attention_scale.gamma.zero_()
                block.mlp_scale.gamma.fill_(1.0 if i == 0 else 0.0)
                torch.nn.init.eye_(block.cross.out_proj.weight)
                block.cross.out_proj.bias.zero_()
                block.mlp.fc2.weight.zero_()
                block.mlp.fc2.bias.zero_()
        gain = INITIAL_GAINS
        geometry = [gain["centre"]] * 3 + [gain["scale"]] * 3 + [gain["quaternion"]] * 4
        appearance = [gain["sh_0"]] * 3 + [gain["sh_rest"]] * 3 * (config.sh_bands - 1) + [gain["opacity"]]
        for head, gains in ((model.geometry_head, geometry), (model.appearance_head, appearance)):
            head.bias.zero_()
            torch.nn.init.eye_(head.weight)
            head.weight *= torch.tensor(gains * config.gaussians_per_query)[:, None]
    return model


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("output", type=Path)
    parser.add_argument("--seed", type=int, default=0)
    arguments = parser.parse_args()
    save(initial_model(preset("compact"), arguments.seed), arguments.output)


if __name__ == "__main__":
    main()
