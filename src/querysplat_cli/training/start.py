"""What a training starts from: the model, which of its tensors learn, and their optimiser."""

from torch import Tensor, nn
from torch.optim import AdamW

from querysplat_cli.model.checkpoints import load
from querysplat_cli.model.initialise import initial_model, scratch_model, with_rounds
from querysplat_cli.model.querysplat import QuerySplat
from querysplat_cli.runtime.errors import QuerySplatError
from querysplat_cli.training.config import OptimiserSettings, TrainConfig, with_queries
from querysplat_cli.training.schedule import trained

HEADS = ("geometry_head.", "appearance_head.")


def starting_model(config: TrainConfig) -> QuerySplat:
    """The model before the first step, which depends only on `config`.

    Raises QuerySplatError when the checkpoint in `config.start` cannot be read, or has another configuration.
    """
    wanted = with_queries(config.model, config.stages[0].queries)
    if config.start == "prior":
        return initial_model(wanted, config.seed)
    if config.start == "scratch":
        return scratch_model(wanted, config.seed)
    model = load(config.start)
    if config.model.refinement_rounds and not model.config.refinement_rounds:
        model = with_rounds(model, config.model, config.seed)
    if with_queries(model.config, wanted.query_count) != wanted:
        raise QuerySplatError(f"{config.start}: a model of another configuration", "Give its own [model] table.")
    return model


def freeze(model: QuerySplat, config: TrainConfig) -> None:
    """Train all tensors but those whose names begin with one of `optimiser.frozen`.

    A model with rounds of refinement trains only their tensors. Raises QuerySplatError where nothing is left to train.
    """
    model.train()
    learning = "refiner." if config.model.refinement_rounds else ""
    for name, parameter in model.named_parameters():
        parameter.requires_grad_(name.startswith(learning) and not name.startswith(config.optimiser.frozen))
    if not any(trained(model)):
        raise QuerySplatError("optimiser.frozen names all that learns", "Name fewer tensors.")


def new_optimiser(model: QuerySplat, settings: OptimiserSettings) -> AdamW:
    """AdamW over the tensors that learn, without moments yet."""
    decaying = [tensor for name, tensor in trained(model) if decays(name, tensor)]
    others = [tensor for name, tensor in trained(model) if not decays(name, tensor)]
    groups = [
        {"params": decaying, "weight_decay": settings.weight_decay},
        {"params": others, "weight_decay": 0.0},
    ]
    return AdamW([group for group in groups if group["params"]], lr=0.0, betas=settings.betas)


def decays(name: str, tensor: Tensor | nn.Parameter) -> bool:
    """Whether weight decay acts on a tensor: on matrices outside of the heads (TokenGS), not on norms and biases.

    Rounds of refinement have heads of their own.
    """
    return tensor.ndim >= 2 and not name.removeprefix("refiner.").startswith(HEADS)
