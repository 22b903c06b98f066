"""Adam with a way back over the last step."""

from dataclasses import replace

import torch

from querysplat_cli.scene.gaussians import Gaussians
from querysplat_cli.tto.gaussians import Changes
from querysplat_cli.tto.variables import Denser, Parametrisation, UndoableVariables
from scenes import camera, cloud

RATE = 0.1


def started() -> tuple[Gaussians, UndoableVariables[Changes]]:
    """Five Gaussians whose centres alone change, by their moves."""
    gaussians = cloud(0, 5, camera(20, 30)).to(torch.float32)
    rates = dict.fromkeys(("moves", "turns", "log_scales", "logits", "colours", "bands"), 1.0)
    start = Parametrisation(
        Changes.none(gaussians), lambda changes: replace(gaussians, means=gaussians.means + changes.moves), rates
    )
    return gaussians, UndoableVariables(start, RATE)


def step(adam: UndoableVariables[Changes], slope: float) -> None:
    (slope * adam.gaussians().means.sum()).backward()
    adam.step(1.0)


def test_an_undone_step_is_taken_back_and_the_next_one_is_no_first_step() -> None:
    """Adam's first steps move every number by the whole rate, however small its gradient is."""
    _, adam = started()
    for _ in range(5):
        step(adam, 1.0)
    before = adam.variables().moves.clone()
    step(adam, 1.0)
    adam.undo()
    torch.testing.assert_close(adam.variables().moves, before, rtol=0, atol=0)
    step(adam, 1e-3)
    assert 0 < float((adam.variables().moves - before).abs().max()) < 0.01 * RATE


def test_squared_gradients_that_overflowed_do_not_stop_the_rest() -> None:
    _, adam = started()
    step(adam, 1e30)
    adam.undo()
    step(adam, 1.0)
    assert bool(adam.variables().moves.isfinite().all())


def test_a_split_and_an_undo_before_the_first_step_are_harmless() -> None:
    gaussians, adam = started()
    rows = torch.tensor([0, 0, 1, 2, 3, 4])
    denser = Denser(Changes.none(gaussians[rows]), lambda changes: gaussians[rows], rows)
    adam.go_on_with(denser)
    adam.undo()
    assert len(adam.gaussians()) == 6


def test_going_back_is_to_the_mark_before_the_last() -> None:
    _, adam = started()
    marked = []
    for _ in range(3):
        marked.append(adam.variables().moves.clone())
        adam.mark()
        step(adam, 1.0)
        step(adam, 1.0)
    adam.go_back()
    assert adam.variables().moves.equal(marked[1])
    step(adam, 1.0)
    adam.go_back()
    assert adam.variables().moves.equal(marked[1])


def test_nothing_earlier_than_what_was_kept_comes_back() -> None:
    """Refined cameras went back to before a split of the scene, which itself did not."""
    _, adam = started()
    step(adam, 1.0)
    adam.keep()
    kept = adam.variables().moves.clone()
    adam.undo()
    assert adam.variables().moves.equal(kept)
    step(adam, 1.0)
    adam.go_back()
    assert adam.variables().moves.equal(kept)
