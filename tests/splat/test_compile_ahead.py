"""What is compiled ahead is what a picture and its loss need, and nothing is compiled again."""

import torch

from querysplat_cli.splat.compile_ahead import SIGNATURES, compile_ahead
from querysplat_cli.splat.render import render
from querysplat_cli.splat.similarity import photometric_loss
from scenes import camera, cloud


def test_nothing_is_left_to_compile() -> None:
    thread = compile_ahead()
    thread.join()
    before = [list(function.signatures) for function, _ in SIGNATURES]
    assert all(before)
    cameras = camera(20, 30, views=2)
    leaves = cloud(0, 30, cameras).to(torch.float32).map(lambda field: field.requires_grad_())
    picture = render(leaves, cameras).colour
    photometric_loss(picture, torch.rand(2, 3, 20, 30), torch.ones(2, 20, 30, dtype=torch.bool)).backward()
    assert [list(function.signatures) for function, _ in SIGNATURES] == before
