"""The whole model: official sizes, the compact model's initial weights, and gradients of the memories."""

from dataclasses import fields

import pytest
import torch
from model_scenes import PATCHES, VIEWS, anchors, compact, memories, photos

from querysplat_cli.model.anchors import Neighbours
from querysplat_cli.model.config import ModelConfig, preset
from querysplat_cli.model.heads import assemble
from querysplat_cli.model.initialise import initial_model
from querysplat_cli.model.memories import Memories, Memory, attended_rows, plucker_rays
from querysplat_cli.model.querysplat import QuerySplat
from querysplat_cli.runtime.errors import QuerySplatError
from querysplat_cli.scene.gaussians import SH_0
from tiny_weights import MODEL as TINY


def test_official_tensor_and_value_counts() -> None:
    with torch.device("meta"):
        state = QuerySplat(preset("official-8192")).state_dict()
    assert len(state) == 521
    assert sum(tensor.numel() for tensor in state.values()) == 1_117_923_780


def test_initial_model_gives_the_prior() -> None:
    config = compact()
    model = initial_model(config, seed=3).requires_grad_(False)
    scene = anchors(config)
    seen = model.keys_and_values(model.embed(*photos(config)))
    assert len(seen.geometry_keys) == len(seen.appearance_keys) == VIEWS * PATCHES
    assert not seen.geometry_values.any()
    assert not seen.appearance_values.any()
    made = model.decode(seen, scene)
    assert torch.equal(made.means, scene.means.flatten(0, 1))
    assert torch.equal(made.scales, scene.scales.flatten(0, 1))
    torch.testing.assert_close(made.quats, scene.quats.flatten(0, 1), rtol=1e-6, atol=1e-7)
    torch.testing.assert_close(made.opacities, scene.opacities.flatten(), rtol=1e-6, atol=1e-6)
    torch.testing.assert_close(0.5 + SH_0 * made.sh[:, 0], scene.colours.flatten(0, 1), rtol=1e-6, atol=1e-6)


def test_values_drive_every_property_of_every_gaussian_from_the_start() -> None:
    """At the initial weights every property of a Gaussian has a gradient in the memories, as TTO needs."""
    config = compact()
    model = initial_model(config, seed=0).requires_grad_(False)
    scene = anchors(config)
    start = model.keys_and_values(model.embed(*photos(config)))
    for name, field in (("means", "geometry_values"), ("scales", "geometry_values"), ("quats", "geometry_values"),
                        ("opacities", "appearance_values"), ("sh", "appearance_values")):  # fmt: skip
        variables = start.map(lambda tensor: tensor.detach().clone().requires_grad_())
        part = getattr(model.decode(variables, scene), name)
        given = torch.randn(part.shape, generator=torch.Generator().manual_seed(1))
        (slope,) = torch.autograd.grad(part, getattr(variables, field), given)
        rows = slope[scene.geometry.index.unique() if field == "geometry_values" else scene.appearance.index.unique()]
        assert (rows.flatten(1) != 0).any(1).all(), name


def test_same_seed_same_weights_and_global_randomness_untouched() -> None:
    torch.manual_seed(5)
    expected = torch.randn(3)
    torch.manual_seed(5)
    first, second, other = (initial_model(compact(), seed).state_dict() for seed in (1, 1, 2))
    assert torch.equal(torch.randn(3), expected)
    assert all(torch.equal(first[name], second[name]) for name in first)
    assert any(not torch.equal(first[name], other[name]) for name in first)


def test_rows_that_no_query_attends_to_can_be_left_out() -> None:
    config = compact()
    model = initial_model(config, seed=0).requires_grad_(False)
    scene = anchors(config, queries=7)
    everything = model.embed(*photos(config))
    fewer, renumbered, (geometry, appearance) = attended_rows(everything, scene)
    assert geometry.equal(scene.geometry.index.unique())
    assert appearance.equal(scene.appearance.index.unique())
    assert fewer.geometry.equal(everything.geometry[geometry])
    assert fewer.appearance.equal(everything.appearance[appearance])
    before, after = model.decode(everything, scene), model.decode(fewer, renumbered)
    for name, part in before.named().items():
        torch.testing.assert_close(after.named()[name], part)


def test_local_decoding_equals_global_decoding_when_every_row_is_near() -> None:
    """Each query has all rows as its neighbours: anchored and learned queries then share one result."""
    config = compact(width=16, heads=2, gaussians_per_query=1)
    torch.manual_seed(0)
    model = QuerySplat(config).double().requires_grad_(False)
    tokens, keys, values = (torch.randn(*shape, dtype=torch.float64) for shape in ((5, 16), (9, 2, 8), (9, 2, 8)))

    def everyone(rows: int) -> Neighbours:
        return Neighbours(torch.arange(rows).expand(5, -1), torch.zeros(5, rows, dtype=torch.float64))

    local = model.geometry_decoder(tokens, Memory(keys, values, everyone(9)), everyone(5))
    torch.testing.assert_close(local, model.geometry_decoder(tokens, Memory(keys, values)), rtol=1e-12, atol=1e-12)


def test_anchors_and_learned_queries_are_not_mixed_up() -> None:
    config = compact()
    with pytest.raises(QuerySplatError):
        QuerySplat(config).decode(memories(config))
    learned = ModelConfig(
        width=16, heads=2, geometry_blocks=1, appearance_blocks=1, query_count=3, gaussians_per_query=2
    )
    with pytest.raises(QuerySplatError):
        QuerySplat(learned).decode(memories(learned), anchors(config))


def test_plucker_rays_pass_through_their_camera_and_their_pixel() -> None:
    _, _, cameras = photos(compact())
    cameras = cameras.to(torch.float64)
    moment, direction = plucker_rays(cameras).split(3, 1)
    torch.testing.assert_close(direction.norm(dim=1), torch.ones_like(direction[:, 0]))
    view, row, column = 2, 3, 7
    point = cameras.centres[view] + 5 * direction[view, :, row, column]
    torch.testing.assert_close(torch.linalg.cross(point, direction[view, :, row, column]), moment[view, :, row, column])
    local = cameras.w2c[view, :3, :3] @ point + cameras.w2c[view, :3, 3]
    pixel = cameras.K[view] @ local / local[2]
    torch.testing.assert_close(pixel[:2], torch.tensor([column + 0.5, row + 0.5], dtype=torch.float64))


def test_blocks_run_again_backward_give_the_same_gradient() -> None:
    """For learned queries nothing is stored inside a block; the gradient is that of the plain chain."""
    torch.manual_seed(0)
    model = QuerySplat(TINY).requires_grad_(False)
    for block in (*model.geometry_decoder.blocks, *model.appearance_decoder.blocks):
        for scale in (block.cross_scale, block.self_attention_scale, block.mlp_scale):
            scale.gamma.fill_(0.3)
    shape = (20, TINY.heads, TINY.width // TINY.heads)
    stored = Memories(*(torch.randn(shape) for _ in range(4))).map(lambda tensor: tensor.requires_grad_())
    tensors = [getattr(stored, field.name) for field in fields(stored)]
    found = torch.autograd.grad(model.decode(stored).means.sum() + model.decode(stored).sh.sum(), tensors)
    tokens = torch.cat([model.eye_token, model.geometry_queries])
    for block in model.geometry_decoder.blocks:
        tokens = block(tokens, stored.geometry())
    after = tokens[1:] + model.appearance_queries
    for block in model.appearance_decoder.blocks:
        after = block(after, stored.appearance())
    made = assemble(*model._raw(tokens[1:], after), TINY)
    expected = torch.autograd.grad(made.means.sum() + made.sh.sum(), tensors)
    for ours, theirs in zip(found, expected, strict=True):
        torch.testing.assert_close(ours, theirs)
