"""Files of weights: official names, strictness, damage, and the bundled checkpoint."""

import json
import math
import pickle
import resource
import struct
from pathlib import Path

import pytest
import torch
from model_scenes import compact
from safetensors.torch import load_file as read_safetensors
from safetensors.torch import save_file

from querysplat_cli.model.checkpoints import load, load_file, official_config, our_name, save
from querysplat_cli.model.config import ModelConfig, preset, preset_names
from querysplat_cli.model.initialise import initial_model
from querysplat_cli.model.querysplat import QuerySplat
from querysplat_cli.runtime.checkpoint_files import check_tensors
from querysplat_cli.runtime.errors import MissingPart, QuerySplatError
from querysplat_cli.training.config import load_config
from tiny_weights import MODEL, official_names, write_model


def small() -> ModelConfig:
    return compact(width=8, heads=2, gaussians_per_query=1)


def test_every_official_name_has_its_own_place() -> None:
    names = official_names()
    with torch.device("meta"):
        model = QuerySplat(preset("official-8192"))
    state = model.state_dict()
    assert len(names) == 521
    assert {our_name(name) for name in names} == state.keys()
    assert our_name("enc_dec_backbone.decoder_blocks.11.gs_self_attn.gs_self_attn.proj.bias") == (
        "geometry_decoder.blocks.11.self_attention.out_proj.bias"
    )
    check_tensors(model, {our_name(name): state[our_name(name)] for name in names}, "the table")


@pytest.mark.parametrize(("rows", "degree"), [(4 * 64, 0), (13 * 64, 1), (28 * 64, 2), (49 * 64, 3)])
def test_sh_degree_is_read_from_the_head(rows: int, degree: int) -> None:
    config = official_config({"appearance_head.bias": torch.empty(rows, device="meta")})
    assert config.sh_degree == degree
    assert config.appearance_channels * config.gaussians_per_query == rows


def test_presets() -> None:
    assert preset_names() == ["compact", "official-8192", "official-paper"]
    assert preset("official-8192") == ModelConfig()
    assert preset("official-paper") == ModelConfig(sh_degree=0)
    assert preset("compact").queries == "anchored"
    with pytest.raises(QuerySplatError, match="compcat") as raised:
        preset("compcat")
    assert "compact" in raised.value.hint


@pytest.mark.parametrize("changes", [{"heads": 3}, {"width": 0}, {"patch": -6}])
def test_impossible_configurations_are_refused(changes: dict[str, object]) -> None:
    with pytest.raises(QuerySplatError):
        compact(**changes)


def test_the_bundled_checkpoint_is_the_analytic_start_where_training_left_it_alone_and_trained_elsewhere() -> None:
    bundled, made = load("compact"), initial_model(preset("compact"), seed=0)
    assert bundled.config == preset("compact")
    frozen = load_config("compact").optimiser.frozen
    for name, tensor in made.state_dict().items():
        same = torch.allclose(bundled.state_dict()[name], tensor, rtol=1e-3, atol=1e-6)
        assert same == name.startswith(frozen) or not tensor.any(), name
    assert bundled.geometry_decoder.blocks[0].mlp.fc2.weight.any()
    assert all(not parameter.requires_grad for parameter in bundled.parameters())


def test_a_file_gives_the_model_that_was_saved(tmp_path: Path) -> None:
    model = initial_model(small(), seed=1)
    save(model, tmp_path / "small.safetensors")
    again = load(str(tmp_path / "small.safetensors"))
    assert again.config == model.config
    for name, tensor in model.state_dict().items():
        assert torch.equal(again.state_dict()[name], tensor.half().float()), name


def test_a_saved_file_can_be_read_by_others(tmp_path: Path) -> None:
    """As far as the user's umask allows; it was for the owner alone."""
    save(load("compact"), tmp_path / "saved.safetensors")
    (tmp_path / "plain").touch()
    assert (tmp_path / "saved.safetensors").stat().st_mode == (tmp_path / "plain").stat().st_mode


@pytest.mark.parametrize("fault", ["missing", "unexpected", "of another shape"])
def test_wrong_tensors_are_named(tmp_path: Path, fault: str) -> None:
    path = tmp_path / "wrong.safetensors"
    save(initial_model(small(), seed=1), path)
    tensors = read_safetensors(path)
    name = "geometry_head.bias"
    if fault == "missing":
        del tensors[name]
    elif fault == "unexpected":
        name = "stranger"
        tensors[name] = torch.zeros(1)
    else:
        tensors[name] = torch.zeros(3)
    save_file(tensors, path, metadata={"config": json.dumps(small().__dict__)})
    with pytest.raises(QuerySplatError) as raised:
        load_file(path)
    assert f"1 {fault}" in raised.value.message
    assert name in raised.value.message
    assert len(raised.value.message.splitlines()) == 1


def test_only_the_first_of_many_wrong_tensors_are_named(tmp_path: Path) -> None:
    save_file({"a": torch.zeros(1)}, tmp_path / "foreign.safetensors")
    with pytest.raises(QuerySplatError, match=r"521 missing .*, …\); 1 unexpected \(a\)"):
        load_file(tmp_path / "foreign.safetensors")


@pytest.mark.parametrize("suffix", [".safetensors", ".pt"])
@pytest.mark.parametrize("content", [b"", b"no checkpoint at all", "cut"])
def test_damaged_files_are_refused(tmp_path: Path, suffix: str, content: bytes | str) -> None:
    path = tmp_path / f"damaged{suffix}"
    if content == "cut":
        if suffix == ".pt":
            torch.save({"a": torch.zeros(100)}, path)
        else:
            save(initial_model(small(), seed=1), path)
        content = path.read_bytes()[:-50]
    assert isinstance(content, bytes)
    path.write_bytes(content)
    with pytest.raises(QuerySplatError, match="not a readable checkpoint"):
        load_file(path)


class Bomb:
    def __reduce__(self) -> tuple[object, tuple[str]]:
        return (eval, ("1 / 0",))


@pytest.mark.filterwarnings("ignore:Detected pickle protocol")
def test_a_pt_file_cannot_run_code(tmp_path: Path) -> None:
    with (tmp_path / "bomb.pt").open("wb") as file:
        pickle.dump(Bomb(), file)
    torch.save({"a": Bomb()}, tmp_path / "bomb2.pt")
    for name in ("bomb.pt", "bomb2.pt"):
        with pytest.raises(QuerySplatError, match="not a readable checkpoint"):
            load_file(tmp_path / name)


def test_a_pt_file_of_something_else_is_refused(tmp_path: Path) -> None:
    torch.save({"epoch": 3}, tmp_path / "other.pt")
    with pytest.raises(QuerySplatError, match="named tensors"):
        load_file(tmp_path / "other.pt")


@pytest.mark.parametrize("stored", ["{", "[]", '{"wdith": 3}', '{"width": "wide"}', '{"queries": "both"}'])
def test_a_broken_configuration_is_refused(tmp_path: Path, stored: str) -> None:
    save_file({"a": torch.zeros(1)}, tmp_path / "broken.safetensors", metadata={"config": stored})
    with pytest.raises(QuerySplatError):
        load_file(tmp_path / "broken.safetensors")


def test_weights_that_are_missing() -> None:
    with pytest.raises(MissingPart):
        load("official-paper")
    with pytest.raises(QuerySplatError, match="neither a preset nor a file"):
        load("/nowhere/weights.safetensors")


def sparse_file(path: Path, config: ModelConfig) -> None:
    """A full-size official file of zeros that takes no room on the disk."""
    with torch.device("meta"):
        state = QuerySplat(config).state_dict()
    header, end = {}, 0
    for name in official_names():
        shape = list(state[our_name(name)].shape)
        size = 4 * math.prod(shape)
        header[name] = {"dtype": "F32", "shape": shape, "data_offsets": [end, end + size]}
        end += size
    text = json.dumps(header).encode()
    text += b" " * (-len(text) % 8)
    with path.open("wb") as file:
        file.write(struct.pack("<Q", len(text)) + text)
        file.truncate(8 + len(text) + end)


@pytest.mark.parametrize(
    ("degree", "values"), [(1, 1_117_923_780), pytest.param(0, 1_116_743_556, marks=pytest.mark.slow)]
)
def test_a_full_size_file_is_mapped_not_read(tmp_path: Path, degree: int, values: int) -> None:
    """A file of 4.2 GiB is loaded without taking its memory, and each of its 521 tensors is required."""
    sparse_file(tmp_path / "full.safetensors", ModelConfig(sh_degree=degree))
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    model = load_file(tmp_path / "full.safetensors")
    assert resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before < 2**20  # 1 GiB in KiB
    assert model.config.sh_degree == degree
    assert len(model.state_dict()) == 521
    assert sum(tensor.numel() for tensor in model.state_dict().values()) == values
    assert float(model.geometry_queries[-1, -1]) == 0


def test_half_precision_is_for_matrices_alone(tmp_path: Path) -> None:
    write_model(tmp_path / "tiny.safetensors")
    model = load_file(tmp_path / "tiny.safetensors", precision="bf16")
    half = {name for name, tensor in model.state_dict().items() if tensor.dtype == torch.bfloat16}
    assert "geometry_decoder.blocks.0.mlp.fc1.weight" in half
    assert not any("norm" in name or "gamma" in name or "head" in name or "queries" in name for name in half)


def mapped_bytes() -> int:
    """Pages of files that this process holds in memory."""
    status = Path("/proc/self/status").read_text().splitlines()
    return next(int(line.split()[1]) * 1024 for line in status if line.startswith("RssFile:"))


@pytest.mark.skipif(not Path("/proc/self/status").is_file(), reason="there is no /proc")
def test_the_file_is_unmapped_where_its_numbers_were_converted(tmp_path: Path) -> None:
    """A single tensor that is still a view of the mapped file would keep the whole file in memory."""
    path = tmp_path / "some.safetensors"
    write_model(path, ModelConfig(**{**MODEL.__dict__, "width": 512, "vgm_width": 512}))
    size = path.stat().st_size
    load_file(path, precision="bf16")  # whatever the first use brings into memory
    before = mapped_bytes()
    model = load_file(path, precision="bf16")
    assert mapped_bytes() - before < size / 4
    assert sum(tensor.nbytes for tensor in model.state_dict().values()) > size / 3


def test_a_preset_is_found_in_a_folder(tmp_path: Path) -> None:
    written = write_model(tmp_path / "querysplat_vggto_1B_512_8192.safetensors")
    loaded = load("official-8192", tmp_path)
    for name, tensor in written.state_dict().items():
        assert torch.equal(loaded.state_dict()[name], tensor), name
    with pytest.raises(MissingPart, match="paper"):
        load("official-paper", tmp_path)
