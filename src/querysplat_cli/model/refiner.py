"""Rounds of refinement: both decoders read where the scene that they made differs from the photos and the depth maps.

In each round a query reads one row of each memory for every view that sees it. The rows belong to the pair of query and
view: what the view's maps hold at the query's projection, in the query's own frame (`queries/evidence.py`). Geometry
and appearance have a decoder each, with shared weights in all rounds. Their heads start at zero, and what they give is
added to the raw numbers of the round before (ReSplat repeats the feedback of rendering errors in the same sense).
"""

from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor, nn
from torch.nn import functional as F

from querysplat_cli.model.anchors import Reading
from querysplat_cli.model.config import GEOMETRY_CHANNELS, ModelConfig

ERROR_CHANNELS = 11
"""Rendering errors of each Gaussian: colour 3, opacity, centre along its own axes 3, size along them 3, pixels."""
STENCIL = 9
"""Depths that a query reads in each view: at its projection and around it, a block apart."""
GEOMETRY_ROW = 2 * STENCIL + 18
"""Numbers of a row of the geometry memory."""
APPEARANCE_ROW_OF_GAUSSIAN, APPEARANCE_ROW_OF_QUERY = 6, 6
"""Numbers of a row of the appearance memory for each Gaussian of the query, and for the query itself."""
PAIR_WIDTH = 64
"""Width of what a pair of query and view, or of two queries, is embedded in before it becomes a key and a value."""


@dataclass(frozen=True)
class Evidence:
    """What one round reads of Q queries, V views each, and K other queries each.

    own: the query's features, rendering errors and raw numbers.
    geometry, appearance: the rows of both memories; `seen` marks those that count, `views` are the views' numbers.
    near, offsets: other queries, and their places along the query's axes in units of its spacing.
    """

    own: Float[Tensor, "queries own"]
    geometry: Float[Tensor, "queries views geometry"]
    appearance: Float[Tensor, "queries views appearance"]
    seen: Bool[Tensor, "queries views"]
    views: Int[Tensor, "queries views"]
    near: Int[Tensor, "queries near"]
    offsets: Float[Tensor, "queries near 3"]


@dataclass(frozen=True)
class Correction:
    """What one round gives: changes of the raw numbers of both heads, what was read, and tokens for the next round."""

    geometry: Float[Tensor, "queries geometry"]
    appearance: Float[Tensor, "queries appearance"]
    tokens: Float[Tensor, "queries width"]
    reading: Reading


class PairAttention(nn.Module):
    """Queries read rows of their own: softmax(q·k) v over the rows that count, and a row of zeros with logit 0.

    A small MLP gives the keys k and values v of the rows. A query without a row reads zeros. The weights are returned,
    too, as means over the heads.
    """

    def __init__(self, width: int, heads: int) -> None:
        super().__init__()
        self.heads = heads
        self.norm = nn.LayerNorm(width)
        self.q_proj = nn.Linear(width, PAIR_WIDTH)
        self.keys_and_values = nn.Linear(PAIR_WIDTH, 2 * PAIR_WIDTH)
        self.out_proj = nn.Linear(PAIR_WIDTH, width)

    def forward(
        self,
        tokens: Float[Tensor, "queries width"],
        rows: Float[Tensor, "queries rows pair"],
        counts: Bool[Tensor, "queries rows"] | None = None,
    ) -> tuple[Float[Tensor, "queries width"], Float[Tensor, "queries rows"]]:
        keys, values = self.keys_and_values.weight.unflatten(0, (2, self.heads, -1))
        of_keys, of_values = self.keys_and_values.bias.unflatten(0, (2, self.heads, -1))
        query = self.q_proj(self.norm(tokens)).unflatten(-1, (self.heads, -1)) / keys.shape[1] ** 0.5
        rows = F.gelu(rows)
        # q·(K r + b) = (Kᵀ q)·r + q·b, and Σ w (V r + b) = V Σ w r + b Σ w: no row needs a key or a value of its own.
        logits = torch.einsum("qhc,hcp->qhp", query, keys) @ rows.mT + (query * of_keys).sum(-1, keepdim=True)
        if counts is not None:
            logits = logits.masked_fill(~counts[:, None], -torch.inf)
        weights = F.pad(logits, (0, 1)).softmax(-1)[..., :-1]
        read = torch.einsum("qhp,hcp->qhc", weights @ rows, values) + weights.sum(-1, keepdim=True) * of_values
        return self.out_proj(read.flatten(1)), weights.detach().mean(1)


class RefinerBlock(nn.Module):
    """A query reads its rows, then its neighbours, then passes an MLP; each is pre-normed and added."""

    def __init__(self, width: int, heads: int, mlp_ratio: float, row_channels: int) -> None:
        super().__init__()
        hidden = int(width * mlp_ratio)
        self.row_embedding = nn.Linear(row_channels, PAIR_WIDTH)
        self.cross = PairAttention(width, heads)
        self.token_embedding = nn.Linear(width, PAIR_WIDTH)
        self.offset_embedding = nn.Linear(3, PAIR_WIDTH)
        self.self_attention = PairAttention(width, heads)
        self.mlp = nn.Sequential(nn.LayerNorm(width), nn.Linear(width, hidden), nn.GELU(), nn.Linear(hidden, width))

    def forward(
        self,
        tokens: Float[Tensor, "queries width"],
        memory: tuple[Float[Tensor, "queries rows channels"], Bool[Tensor, "queries rows"]],
        evidence: Evidence,
    ) -> tuple[Float[Tensor, "queries width"], Float[Tensor, "queries rows"]]:
        """The tokens, and how much of each row they read. `memory` are the rows, and which of them count."""
        rows, counts = memory
        read, weights = self.cross(tokens, self.row_embedding(rows), counts)
        tokens = tokens + read
        others = F.embedding(evidence.near, self.token_embedding(tokens)) + self.offset_embedding(evidence.offsets)
        tokens = tokens + self.self_attention(tokens, others)[0]
        return tokens + self.mlp(tokens), weights


class Refiner(nn.Module):
    """One round: evidence to changes of the raw numbers.

    With `ModelConfig.refinement` "one-branch", all blocks read the rows of both memories side by side, and both heads
    read what the last block gives.
    """

    def __init__(self, config: ModelConfig) -> None:
        super().__init__()
        self._kind = config.refinement
        width, heads, ratio = config.width, config.heads, config.mlp_ratio
        per_query = config.gaussians_per_query
        each = ERROR_CHANNELS + config.raw_channels
        geometry, appearance = GEOMETRY_ROW, APPEARANCE_ROW_OF_GAUSSIAN * per_query + APPEARANCE_ROW_OF_QUERY
        if self._kind == "one-branch":
            geometry = appearance = geometry + appearance
        self.embedding = nn.Linear(config.anchor_features + each * per_query, width)
        self.geometry_blocks = nn.ModuleList(RefinerBlock(width, heads, ratio, geometry) for _ in range(2))
        self.geometry_head = nn.Linear(width, per_query * GEOMETRY_CHANNELS)
        self.appearance_block = RefinerBlock(width, heads, ratio, appearance)
        self.appearance_head = nn.Linear(width, per_query * config.appearance_channels)
        for head in (self.geometry_head, self.appearance_head):
            nn.init.zeros_(head.weight)
            nn.init.zeros_(head.bias)

    def forward(self, evidence: Evidence, memory: Float[Tensor, "queries width"] | None) -> Correction:
        """`memory` are the tokens of the round before."""
        tokens = self.embedding(evidence.own)
        if memory is not None:
            tokens = tokens + memory
        geometry, appearance = self._memories(evidence)
        weights = []
        for block in self.geometry_blocks:
            tokens, of_block = block(tokens, geometry, evidence)
            weights.append(of_block)
        after, last = self.appearance_block(tokens, appearance, evidence)
        return Correction(
            self.geometry_head(after if self._kind == "one-branch" else tokens),
            self.appearance_head(after),
            after,
            Reading(evidence.views, torch.stack(weights).mean(0), last),
        )

    def _memories(self, evidence: Evidence) -> tuple[tuple[Tensor, Tensor], tuple[Tensor, Tensor]]:
        """What the geometry blocks and the appearance block read: rows, and which of them count."""
        seen = evidence.seen
        if self._kind == "one-branch":
            both = torch.cat([evidence.geometry, evidence.appearance], -1), seen
            return both, both
        nothing = torch.zeros_like(seen)
        return (
            (evidence.geometry, nothing if self._kind in ("no-geometry-memory", "no-memory") else seen),
            (evidence.appearance, nothing if self._kind in ("no-appearance-memory", "no-memory") else seen),
        )
