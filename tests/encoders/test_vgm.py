"""VGGT-Omega and VGGT where the golden fixtures do not reach: chunks, mixtures, shapes, files, exchange."""

import json
from pathlib import Path

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from safetensors.torch import load_file, save_file

from parity_encoders import encode_pose
from querysplat_cli.encoders.base import CameraRequest, Encoder, EncoderOptions
from querysplat_cli.encoders.registry import find_encoder
from querysplat_cli.encoders.transformer.config import VgmConfig
from querysplat_cli.encoders.transformer.pose import decode_pose
from querysplat_cli.encoders.transformer.vgm import Vgm, load_vgm
from querysplat_cli.encoders.vggt.model import VGGT_CONFIG, Vggt
from querysplat_cli.encoders.vggt_omega.model import VGGT_OMEGA_CONFIG, VggtOmega
from querysplat_cli.model.memories import LayerMixer
from querysplat_cli.runtime.errors import MissingPart, QuerySplatError
from querysplat_cli.scene.views import Photo
from tiny_weights import MODEL, OMEGA, VGGT, write_model, write_vgm

KINDS = [(VggtOmega, OMEGA), (Vggt, VGGT)]


def photos(views: int, height: int = 64, width: int = 96, seed: int = 0) -> torch.Tensor:
    return torch.rand(views, 3, height, width, generator=torch.Generator().manual_seed(seed))


@pytest.mark.parametrize(("make", "config"), KINDS)
def test_views_in_chunks_are_views_at_once(tmp_path: Path, make: type[Vgm], config: VgmConfig) -> None:
    vgm = write_vgm(tmp_path / "a.safetensors", make, config)
    images = photos(5, 3 * config.patch, 4 * config.patch)
    together = list(vgm.aggregator.layers(images, chunk=5))
    for chunk in (1, 2, 3):
        for mine, whole in zip(vgm.aggregator.layers(images, chunk=chunk), together, strict=True):
            torch.testing.assert_close(mine, whole, rtol=1e-4, atol=1e-5)


@pytest.mark.parametrize(("make", "config"), KINDS)
def test_a_mixture_equals_that_of_the_model(tmp_path: Path, make: type[Vgm], config: VgmConfig) -> None:
    vgm = write_vgm(tmp_path / "a.safetensors", make, config)
    model = write_model(tmp_path / "model.safetensors")
    images = photos(3, 2 * config.patch, 3 * config.patch)
    layers = vgm.predict(images, depth=False).features
    (mixed,) = vgm.predict(images, mixture=model.layer_weights, depth=False).features
    assert isinstance(model.layer_mixer, LayerMixer)
    expected = model.layer_mixer(layers, model.eye_token)
    torch.testing.assert_close(model.layer_mixer((mixed,), model.eye_token), expected, rtol=1e-4, atol=1e-5)


@pytest.mark.parametrize(("make", "config"), KINDS)
@pytest.mark.parametrize("rows", [1, 2, 5])
@pytest.mark.parametrize("views", [1, 3])
def test_shapes_of_any_aspect(tmp_path: Path, make: type[Vgm], config: VgmConfig, rows: int, views: int) -> None:
    vgm = write_vgm(tmp_path / "a.safetensors", make, config)
    height, width = rows * config.patch, 3 * config.patch
    found = vgm.predict(photos(views, height, width))
    assert [tuple(layer.shape) for layer in found.features] == [(views, 5 + 3 * rows, 2 * config.width)] * 4
    assert found.depth is not None
    assert found.confidence is not None
    assert found.depth.shape == found.confidence.shape == (views, height, width)
    assert (found.depth > 0).all()
    assert ((found.confidence >= 0) & (found.confidence < 1)).all()
    assert (found.cameras.height, found.cameras.width) == (height, width)
    torch.testing.assert_close(found.cameras.K[:, 0, 2], torch.full((views,), width / 2))


@pytest.mark.parametrize(("make", "config"), KINDS)
def test_pictures_that_are_no_whole_patches_are_refused(tmp_path: Path, make: type[Vgm], config: VgmConfig) -> None:
    vgm = write_vgm(tmp_path / "a.safetensors", make, config)
    with pytest.raises(QuerySplatError, match="do not divide"):
        vgm.predict(photos(1, 3 * config.patch, 3 * config.patch + 1))


def test_register_blocks_leave_patches_alone(tmp_path: Path) -> None:
    """In a register block both halves of a patch token are equal; in the others they are not."""
    config = VgmConfig(**{**OMEGA.__dict__, "register_blocks": (2,)})
    vgm = write_vgm(tmp_path / "a.safetensors", VggtOmega, config)
    for i, layer in enumerate(vgm.aggregator.layers(photos(2))):
        alone, together = layer[:, 5:].chunk(2, -1)
        assert torch.equal(alone, together) == (i == 2)


def test_half_precision_is_near(tmp_path: Path) -> None:
    """bfloat16 has 8 bits: the error is a few per cent after a few blocks. Heads stay in float32."""
    write_vgm(tmp_path / "a.safetensors")
    exact, rough = (load_vgm(VggtOmega, OMEGA, tmp_path / "a.safetensors", precision=each) for each in ("fp32", "bf16"))
    assert rough.aggregator.frame_blocks[0].attn.qkv.weight.dtype == torch.bfloat16
    assert rough.aggregator.frame_blocks[0].norm1.weight.dtype == torch.float32
    assert {tensor.dtype for tensor in rough.dense_head.state_dict().values()} == {torch.float32}
    images = photos(3)
    a, b = exact.predict(images), rough.predict(images)
    assert a.features[-1].dtype == b.features[-1].dtype == torch.float32
    error = (a.features[-1] - b.features[-1]).norm() / a.features[-1].norm()
    assert 1e-4 < error < 0.05
    assert a.depth is not None
    assert b.depth is not None
    assert ((a.depth - b.depth).abs() / a.depth).median() < 0.05


@given(st.lists(st.floats(-3, 3), min_size=9, max_size=9), st.integers(16, 600), st.integers(16, 600))
def test_pose_codec_goes_round(numbers: list[float], height: int, width: int) -> None:
    encoding = torch.tensor([numbers], dtype=torch.float64)
    if encoding[:, 3:7].norm() < 1e-3:
        return
    encoding[:, 7:] = 0.05 + encoding[:, 7:].abs()
    cameras = decode_pose(encoding, height, width)
    again = encode_pose(cameras)
    torch.testing.assert_close(again[:, :3], encoding[:, :3])
    torch.testing.assert_close(again[:, 7:], encoding[:, 7:])
    assert again[0, 6] >= 0
    unit = torch.nn.functional.normalize(encoding[:, 3:7])
    assert abs(float((again[:, 3:7] * unit).sum())) == pytest.approx(1, abs=1e-9)
    rotation = cameras.w2c[0, :3, :3]
    torch.testing.assert_close(rotation @ rotation.T, torch.eye(3, dtype=torch.float64), atol=1e-12, rtol=0)


@pytest.mark.parametrize(
    ("make", "config", "tensors"), [(VggtOmega, VGGT_OMEGA_CONFIG, 1411), (Vggt, VGGT_CONFIG, 1341)]
)
def test_full_size_files_load_strictly(tmp_path: Path, make: type[Vgm], config: VgmConfig, tensors: int) -> None:
    """All official names and shapes, in a small .pt file: every tensor repeats one number."""
    with torch.device("meta"):
        state = make(config).state_dict()
    assert len(state) == tensors
    path = tmp_path / "full.pt"
    stored = {name: torch.zeros(1).expand(tensor.shape) for name, tensor in state.items()}
    torch.save(stored | {"text_alignment_head.weight": torch.zeros(3)}, path)
    vgm = load_vgm(make, config, path)
    assert {name: tensor.shape for name, tensor in vgm.state_dict().items()} == {
        name: tensor.shape for name, tensor in state.items()
    }
    del stored["aggregator.camera_token"]
    torch.save(stored, path)
    with pytest.raises(QuerySplatError, match=r"1 missing \(aggregator.camera_token\)"):
        load_vgm(make, config, path)


@pytest.mark.parametrize("stored", ["{", "[]", '{"widht": 32}', '{"width": "wide"}'])
def test_a_broken_configuration_is_refused(tmp_path: Path, stored: str) -> None:
    save_file({"a": torch.zeros(1)}, tmp_path / "a.safetensors", metadata={"config": stored})
    with pytest.raises(QuerySplatError):
        load_vgm(VggtOmega, OMEGA, tmp_path / "a.safetensors")


def test_encoders_are_exchanged_without_touching_the_decoders(tmp_path: Path) -> None:
    """The same decoder works on the features of either VGM."""
    write_vgm(tmp_path / "vggt_omega_1b_512.safetensors")
    write_vgm(tmp_path / "model.safetensors", Vggt, VGGT)
    model = write_model(tmp_path / "model_file.safetensors")
    images = photos(2, 112, 112)
    made = []
    for name in ("vggt_omega", "vggt"):
        encoder = find_encoder(name, EncoderOptions(tmp_path, mixture=model.layer_weights, depth=False))
        assert isinstance(encoder, Encoder)
        found = encoder._model.predict(images, mixture=model.layer_weights, depth=False)
        model.check_features(found.features, 112, 112)
        made.append(model.decode(model.embed(found.features, images, found.cameras)))
        assert len(made[-1]) == MODEL.query_count * MODEL.gaussians_per_query
    assert not torch.allclose(made[0].means, made[1].means)


def test_cameras_relative_to_the_first_view_are_moved_rigidly(tmp_path: Path) -> None:
    """The paper's frame: the first camera is the origin, and nothing moves against anything else."""
    write_vgm(tmp_path / "vggt_omega_1b_512.safetensors")
    pictures = [
        Photo(f"{i}.png", Path(f"{i}.png"), (255 * image.permute(1, 2, 0)).byte().numpy())
        for i, image in enumerate(photos(3, 112, 112))
    ]
    found = {}
    for frame in ("predicted", "first_view"):
        encoder = find_encoder("vggt_omega", EncoderOptions(tmp_path, frame=frame))
        found[frame] = encoder.estimate_cameras(pictures, CameraRequest(112, 0), lambda text, fraction: None)
    before, after = found["predicted"], found["first_view"]
    assert not torch.allclose(before.cameras.w2c[0], torch.eye(4), atol=1e-2)
    torch.testing.assert_close(after.cameras.w2c[0], torch.eye(4), atol=1e-6, rtol=0)
    one, other = (each.cameras.w2c[1] @ each.cameras.w2c[0].inverse() for each in (before, after))
    torch.testing.assert_close(one, other, atol=1e-5, rtol=1e-5)
    torch.testing.assert_close(
        before.cameras.local(before.points, 2), after.cameras.local(after.points, 2), atol=1e-4, rtol=1e-4
    )


def test_no_point_comes_from_what_is_padded_or_masked(tmp_path: Path) -> None:
    """The network's depth of white padding means nothing, but it was taken for points of the scene."""
    write_vgm(tmp_path / "vggt_omega_1b_512.safetensors")
    encoder = find_encoder("vggt_omega", EncoderOptions(tmp_path, fit="pad"))
    mask = np.ones((112, 112), bool)
    mask[:, :50] = False
    pictures = [
        Photo(f"{i}.png", Path(f"{i}.png"), np.full((*size, 3), 90, np.uint8), mask=part)
        for i, (size, part) in enumerate([((112, 64), None), ((64, 112), None), ((112, 112), mask)])
    ]
    found = encoder.estimate_cameras(pictures, CameraRequest(112, 0), lambda text, fraction: None)
    assert sum(map(len, found.visibility)) == len(found.points) > 0
    for view, rows in enumerate(found.visibility):
        x, y, _ = found.cameras.project(found.points[rows], view)
        assert len(rows) == int(found.views.masks[view, 8::16, 8::16].sum())
        assert found.views.masks[view, y.long(), x.long()].all()


def test_missing_weights_name_their_source(tmp_path: Path) -> None:
    with pytest.raises(MissingPart, match=r"vggt_omega_1b_512\.pt") as raised:
        find_encoder("vggt_omega", EncoderOptions(tmp_path))
    assert "facebook/VGGT-Omega" in raised.value.hint
    assert "access" in raised.value.hint


def test_a_file_cut_short_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "vggt_omega_1b_512.safetensors"
    write_vgm(path)
    path.write_bytes(path.read_bytes()[:-100])
    with pytest.raises(QuerySplatError, match="not a readable checkpoint"):
        find_encoder("vggt_omega", EncoderOptions(tmp_path))


def test_the_configuration_travels_with_the_file(tmp_path: Path) -> None:
    write_vgm(tmp_path / "a.safetensors")
    tensors = load_file(tmp_path / "a.safetensors")
    save_file(tensors, tmp_path / "b.safetensors", metadata={"config": json.dumps(OMEGA.__dict__)})
    assert load_vgm(VggtOmega, VGGT_OMEGA_CONFIG, tmp_path / "b.safetensors").config == OMEGA
