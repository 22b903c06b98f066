"""The file from which a training resumes exactly where it was."""

import json
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
from safetensors.torch import save
from torch import Tensor, nn

from querysplat_cli.runtime.checkpoint_files import read_tensors
from querysplat_cli.runtime.errors import QuerySplatError
from querysplat_cli.scene.files import atomic_path

FORMAT = 1


@dataclass(frozen=True)
class TrainState:
    """After `step` steps: tensors under "model.", "average." and "moments." (AdamW's, by parameter), and the rest.

    `facts` holds the configuration, the filter's window, and how many samples were skipped.
    """

    step: int
    tensors: Mapping[str, Tensor]
    facts: dict[str, Any]

    def part(self, name: str) -> dict[str, Tensor]:
        """The tensors under `name`, without it."""
        return {key.partition(".")[2]: tensor for key, tensor in self.tensors.items() if key.startswith(f"{name}.")}


def moments(optimiser: torch.optim.Optimizer, named: Mapping[str, nn.Parameter]) -> dict[str, Tensor]:
    """AdamW's state as named tensors: NAME.exp_avg, NAME.exp_avg_sq, NAME.step."""
    return {
        f"{name}.{key}": value
        for name, parameter in named.items()
        for key, value in optimiser.state.get(parameter, {}).items()
    }


def restore_moments(
    optimiser: torch.optim.Optimizer, named: Mapping[str, nn.Parameter], stored: Mapping[str, Tensor]
) -> None:
    """Put the tensors of `moments` back into an optimiser."""
    for key, tensor in stored.items():
        name, _, kind = key.rpartition(".")
        parameter = named[name]
        optimiser.state[parameter][kind] = tensor.clone() if kind == "step" else tensor.clone().to(parameter.device)


def write_state(path: Path, state: TrainState) -> None:
    """Replace `path`. If the process is killed meanwhile, the previous file stays."""
    kept = {name: tensor.detach().cpu().contiguous() for name, tensor in state.tensors.items()}
    facts = {"format": FORMAT, "step": state.step, **state.facts}
    with atomic_path(path) as draft:
        draft.write_bytes(save(kept, metadata={"training": json.dumps(facts)}))


def read_state(path: Path) -> TrainState:
    """Raises QuerySplatError when there is none, or it is damaged."""
    if not path.is_file():
        raise QuerySplatError(f"{path.parent}: no training to go on with", "Leave --resume out to start one.")
    tensors, metadata = read_tensors(path)
    try:
        facts = json.loads(metadata["training"])
        if facts.pop("format") != FORMAT:
            raise ValueError("made by another version")
        return TrainState(facts.pop("step"), tensors, facts)
    except (KeyError, ValueError, TypeError, AttributeError, RecursionError) as error:
        raise QuerySplatError(f"{path}: no training state: {error}", "Start the training again.") from error
