"""QuerySplat (paper, section 3): queries read a frozen VGM's features and the photos, and become Gaussians.

VGM layers ─► layer mixer ─► geometry K, V ─┐
queries ─────────────────────► geometry decoder ─► centres, scales, rotations
                                   │ + appearance queries
photos, rays ─► appearance K, V ─► appearance decoder ─► opacity, SH
"""

from collections.abc import Sequence
from dataclasses import replace

import torch
from jaxtyping import Float
from torch import Tensor, nn

from querysplat_cli.model.anchors import Anchors, Neighbours
from querysplat_cli.model.config import GEOMETRY_CHANNELS, ModelConfig
from querysplat_cli.model.decoders import Decoder
from querysplat_cli.model.heads import assemble, assemble_anchored
from querysplat_cli.model.memories import Features, KeyValue, LayerMixer, Memories, Memory, PhotoEmbedding
from querysplat_cli.model.refiner import Refiner
from querysplat_cli.runtime.errors import QuerySplatError
from querysplat_cli.scene.cameras import Cameras
from querysplat_cli.scene.gaussians import Gaussians


class QuerySplat(nn.Module):
    """Both decoders, their memories' projections, and the heads. One scene at a time."""

    def __init__(self, config: ModelConfig) -> None:
        super().__init__()
        self.config = config
        width, heads = config.width, config.heads
        self.eye_token = nn.Parameter(0.01 * torch.randn(1, width)) if config.has_eye else None
        self.layer_mixer = LayerMixer(config)
        self.geometry_memory = KeyValue(width, heads)
        self.geometry_decoder = Decoder(config.geometry_blocks, width, heads, config.mlp_ratio)
        self.geometry_head = nn.Linear(width, config.gaussians_per_query * GEOMETRY_CHANNELS)
        self.photo_embedding = PhotoEmbedding(config)
        self.appearance_memory = KeyValue(width, heads)
        self.appearance_decoder = Decoder(config.appearance_blocks, width, heads, config.mlp_ratio)
        self.appearance_head = nn.Linear(width, config.gaussians_per_query * config.appearance_channels)
        tokens = config.query_count if config.queries == "learned" else 1
        self.geometry_queries = nn.Parameter(0.01 * torch.randn(tokens, width))
        self.appearance_queries = nn.Parameter(torch.zeros(tokens, width))
        if config.queries == "anchored":
            self.anchor_embedding = nn.Linear(config.anchor_features, width)
        if config.refinement_rounds:
            self.refiner = Refiner(config)

    @property
    def layer_weights(self) -> tuple[float, ...] | None:
        """The weights that mix the VGM's layers, the same for every photo; None where there is one layer."""
        if self.eye_token is None:
            return None
        with torch.no_grad():
            return tuple(self.layer_mixer.weights(self.eye_token).tolist())

    def keep_queries(self, count: int) -> None:
        """Keep the first `count` learned queries; raises QuerySplatError when there are fewer."""
        if count > self.config.query_count:
            raise QuerySplatError(
                f"--queries {count}: the model has {self.config.query_count} learned queries", "Ask for fewer."
            )
        self.geometry_queries = nn.Parameter(self.geometry_queries[:count], requires_grad=False)
        self.appearance_queries = nn.Parameter(self.appearance_queries[:count], requires_grad=False)
        self.config = replace(self.config, query_count=count)

    def check_features(self, features: Sequence[Tensor], height: int, width: int) -> None:
        """Raises QuerySplatError when the model cannot read these features, or pictures of this size in pixels."""
        config = self.config
        if features[-1].shape[-1] != config.vgm_width or len(features) not in (1, config.mixed_layers):
            raise QuerySplatError(
                f"the encoder gives {len(features)} layers of {features[-1].shape[-1]} channels, the model reads "
                f"{config.mixed_layers} of {config.vgm_width}",
                "Use the preset's own encoder.",
            )
        if config.queries == "learned" and (height % config.patch or width % config.patch):
            raise QuerySplatError(
                f"the model reads patches of {config.patch} pixels, the pictures are {width} × {height}",
                "Choose a --max-size that both patches divide, for instance 448.",
            )

    @property
    def weight_bytes(self) -> int:
        return sum(tensor.nbytes for tensor in self.state_dict().values())

    def bytes_needed(self, views: int, size: int, special_tokens: int, *, optimising: bool = False) -> int:
        """Estimated peak memory of decoding, with weights, features and memories. Pictures are `size` pixels square.

        When memories are optimised, their gradients and two moments are added, and the tokens between blocks.
        """
        config = self.config
        share = self.geometry_memory.proj.weight.element_size() / 4
        patches = views * (size // config.patch) ** 2
        tokens = patches + views * special_tokens
        # Features, their norm, and keys and values with a copy of each while they are joined; photos alike.
        memory = (2 + 4 * share) * 4 * config.width * (tokens + patches)
        # Residual stream, a branch's input, its widened result twice, and the raw numbers of both heads.
        raw = config.gaussians_per_query * config.raw_channels
        queries = config.query_count * 4 * (config.width * (3 + 2 * config.mlp_ratio * share) + 3 * raw)
        if optimising:
            memory += 4 * 2 * 4 * config.width * (tokens + patches)
            blocks = config.geometry_blocks + config.appearance_blocks
            queries += config.query_count * 4 * config.width * (blocks + 4 * (8 + 2 * config.mlp_ratio))
        return int(self.weight_bytes + memory + queries)

    def embed(
        self,
        features: Sequence[Float[Tensor, "views tokens channels"]],
        images: Float[Tensor, "views 3 height width"],
        cameras: Cameras,
    ) -> Features:
        """Tokens of both branches. `images` in [0, 1], sides multiples of the patch."""
        return Features(self.layer_mixer(features, self.eye_token), self.photo_embedding(images, cameras))

    def keys_and_values(self, features: Features, origin: Features | None = None) -> Memories:
        """Keys and values of the tokens of both branches.

        With an `origin`, the values also have a residual path: the change of the tokens since then is added to them,
        channel by channel. Without a change it adds exactly nothing.
        """
        found = Memories(*self.geometry_memory(features.geometry), *self.appearance_memory(features.appearance))
        if origin is None:
            return found
        geometry, appearance = features.geometry - origin.geometry, features.appearance - origin.appearance
        return replace(
            found,
            geometry_values=found.geometry_values + geometry.view_as(found.geometry_values),
            appearance_values=found.appearance_values + appearance.view_as(found.appearance_values),
        )

    def decode(self, memories: Memories | Features, anchors: Anchors | None = None) -> Gaussians:
        """Everything after the memories (or features): queries × Gaussians per query, query by query.

        Anchored queries need `anchors`, learned ones take none; raises QuerySplatError otherwise.
        """
        if (anchors is not None) != (self.config.queries == "anchored"):
            raise QuerySplatError("anchored queries need anchors, and learned ones take none", "This is a bug.")
        if isinstance(memories, Features):
            memories = self.keys_and_values(memories)
        if anchors is None:
            tokens = self.geometry_tokens(memories)
            after = self.appearance_tokens(tokens, memories)
            return assemble(*self._raw(tokens, after), self.config)
        return assemble_anchored(*self.anchored_raw(memories, anchors), anchors, self.config)

    def anchored_raw(
        self, memories: Memories, anchors: Anchors
    ) -> tuple[Float[Tensor, "n geometry"], Float[Tensor, "n appearance"]]:
        """Raw numbers of both heads for anchored queries, with what rounds of feedback added to them."""
        embedded = self.geometry_queries + self.anchor_embedding(anchors.features)
        tokens = self.geometry_decoder(embedded, self.first_memory(memories, anchors), anchors.queries)
        start = tokens + self.appearance_queries
        after = self.appearance_decoder(start, memories.appearance(anchors.appearance), anchors.queries)
        # The anchor's prior already holds what the embedding holds, so the heads read only what the decoders added.
        added = after - start if self.config.appearance_blocks else tokens - embedded
        geometry, appearance = self._raw(tokens - embedded, added)
        if not anchors.refinement.shape[2]:
            return geometry, appearance
        refinement = anchors.refinement.flatten(0, 1)
        return geometry + refinement[:, :GEOMETRY_CHANNELS], appearance + refinement[:, GEOMETRY_CHANNELS:]

    def geometry_tokens(self, memories: Memories) -> Float[Tensor, "queries width"]:
        """Learned queries after the geometry decoder. The eye token takes part as one more query."""
        assert self.eye_token is not None
        tokens = torch.cat([self.eye_token, self.geometry_queries])
        return self.geometry_decoder(tokens, self.first_memory(memories, None))[1:]

    def appearance_tokens(
        self, geometry: Float[Tensor, "queries width"], memories: Memories
    ) -> Float[Tensor, "queries width"]:
        """Geometry tokens after the appearance decoder."""
        start = geometry + self.appearance_queries
        return self.appearance_decoder(start, memories.appearance())

    def first_memory(self, memories: Memories, anchors: Anchors | None) -> Memory:
        """What the first decoder reads: the geometry memory, or both where there is one branch."""
        geometry = memories.geometry(None if anchors is None else anchors.geometry)
        if self.config.branches == "two":
            return geometry
        near = None
        if anchors is not None:
            index = torch.cat([anchors.geometry.index, anchors.appearance.index + len(geometry.keys)], 1)
            near = Neighbours(index, torch.cat([anchors.geometry.bias, anchors.appearance.bias], 1))
        keys = torch.cat([geometry.keys, memories.appearance_keys])
        return Memory(keys, torch.cat([geometry.values, memories.appearance_values]), near)

    def _raw(self, geometry: Tensor, appearance: Tensor) -> tuple[Tensor, Tensor]:
        """Raw numbers of both heads, a row for each Gaussian, in the type of the queries even under autocast."""
        per_query, dtype = self.config.gaussians_per_query, self.geometry_queries.dtype
        return (
            self.geometry_head(geometry).to(dtype).unflatten(-1, (per_query, -1)).flatten(0, 1),
            self.appearance_head(appearance).to(dtype).unflatten(-1, (per_query, -1)).flatten(0, 1),
        )
