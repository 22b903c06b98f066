"""The pages of the documentation: their links lead somewhere, the files they name exist, and their examples run."""

import doctest
import json
import re
from dataclasses import fields, replace
from pathlib import Path
from types import ModuleType
from typing import Any

import pytest
import torch

import querysplat_cli
from querysplat_cli.encoders.base import Encoder, PosedViews
from querysplat_cli.encoders.classical.patch_features import FEATURE_CHANNELS
from querysplat_cli.reporting.report import Report
from querysplat_cli.scene.cameras import Cameras
from querysplat_cli.scene.gaussians import Gaussians
from querysplat_cli.scene.views import Views
from querysplat_cli.splat import render as render_module
from querysplat_cli.splat.render import BACKENDS, render
from querysplat_cli.tto.options import TtoSettings

ROOT = Path(__file__).resolve().parents[2]
DOCS = ROOT / "docs"
PAGES = [ROOT / "README.md", ROOT / "CHANGELOG.md", *sorted(DOCS.rglob("*.md"))]
FENCED = re.compile(r"^```(\w*) ?(\w*)\n(.*?)^```$", re.MULTILINE | re.DOTALL)


def named(page: Path) -> str:
    return str(page.relative_to(ROOT))


def prose(page: Path) -> str:
    """The page without its fenced blocks."""
    return FENCED.sub("", page.read_text())


def anchors(page: Path) -> set[str]:
    """The names that GitHub gives to the headings of a page."""
    headings = re.findall(r"^#+ (.+)$", prose(page), re.MULTILINE)
    texts = (re.sub(r"\[(.*?)\]\(.*?\)", r"\1", heading).lower() for heading in headings)
    return {re.sub(r"[^\w\- ]", "", text).replace(" ", "-") for text in texts}


def blocks(page: str, mark: str = "") -> list[str]:
    """The fenced blocks of Python on a page whose fence says "python MARK"."""
    found = FENCED.findall((DOCS / page).read_text())
    return [text for language, word, text in found if language == "python" and word == mark]


@pytest.mark.parametrize("page", PAGES, ids=named)
def test_every_link_leads_to_a_file_and_a_heading(page: Path) -> None:
    broken = []
    for target in re.findall(r"\]\(([^)\s]+)\)", prose(page)):
        if "://" in target:
            continue
        path, _, anchor = target.partition("#")
        place = (page.parent / path).resolve() if path else page
        if not place.exists() or (anchor and anchor not in anchors(place)):
            broken.append(target)
    assert broken == []


@pytest.mark.parametrize("page", PAGES, ids=named)
def test_every_file_that_a_page_names_exists(page: Path) -> None:
    """Files of the package are named by box and path, others from the root of the repository."""
    package = ROOT / "src" / "querysplat_cli"
    roots = {path.name: package for path in package.iterdir()} | dict.fromkeys(("src", "tests", "benchmarks"), ROOT)
    found = re.findall(r"`((?:[\w.-]+/)+[\w.-]+\.(?:py|toml))`", prose(page))
    folders = ((name, roots.get(name.split("/")[0])) for name in found)
    missing = {name for name, folder in folders if folder and not (folder / name).exists()}
    assert not missing


def test_every_test_that_the_stability_cases_name_exists() -> None:
    named_there = set(re.findall(r"`(test_\w+)`", (DOCS / "reference" / "stability-cases.md").read_text()))
    tests = "".join(path.read_text() for path in (ROOT / "tests" / "splat").glob("test_*.py"))
    assert len(named_there) > 20
    assert named_there <= set(re.findall(r"^def (test_\w+)", tests, re.MULTILINE))


def test_the_table_of_the_report_has_every_key() -> None:
    table = (DOCS / "cli.md").read_text().partition("### The report\n")[2].partition("\n## ")[0]
    keys = {re.split(r"[.\[]", key)[0] for key in re.findall(r"^\| `([^`]+)`", table, re.MULTILINE)}
    assert keys == {field.name for field in fields(Report)} | {"doubts"}
    runs = "".join(re.findall(r"^\| `tto\[\].*", table, re.MULTILINE))
    run_keys = set(re.findall(r"(?:tto\[\]|, `)\.(\w+)`", runs))
    assert run_keys >= {field.name for field in fields(TtoSettings)} | {"space", "curve", "cameras"}


def run(texts: list[str], names: dict[str, Any]) -> dict[str, Any]:
    """Run the examples in order; the names that they leave behind."""
    parser, runner = doctest.DocTestParser(), doctest.DocTestRunner(optionflags=doctest.NORMALIZE_WHITESPACE)
    for number, text in enumerate(texts):
        example = parser.get_doctest(text, names, f"python.md, example {number}", None, 0)
        assert example.examples
        failures: list[str] = []
        assert runner.run(example, out=failures.append, clear_globs=False).failed == 0, "".join(failures)
        names = example.globs
    return names


def test_the_examples_of_the_library_run(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    assert len(run(blocks("python.md"), {})) > 5


@pytest.mark.slow
def test_the_examples_that_make_a_scene_run(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    """On the photos of the demo. Doctest compares what is printed, and nothing is said elsewhere."""
    from querysplat_cli.scene.pictures import eight_bit, write_picture
    from querysplat_cli.training.photographer import cast, walk
    from querysplat_cli.training.rooms import make_room

    monkeypatch.chdir(tmp_path)
    Path("photos").mkdir()
    scene = make_room(42)
    cameras = walk(scene, 12, 42)
    for i in range(0, 12, 2):
        write_picture(Path("photos") / f"{i:02}.png", eight_bit(cast(scene, cameras[[i]])[0][0]), [])
    run(blocks("python.md", "slow"), run(blocks("python.md"), {}))
    assert capfd.readouterr().err == ""


@pytest.mark.slow
def test_the_notebook_runs(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Its cells of code run one after the other. It takes its photos from the demo's room."""
    monkeypatch.chdir(tmp_path)
    names: dict[str, Any] = {}
    for cell in json.loads((DOCS / "notebook.ipynb").read_text())["cells"]:
        if cell["cell_type"] == "code":
            exec(compile("".join(cell["source"]), "notebook.ipynb", "exec"), names)
    assert names["scene"].report.quality["heldout"]["psnr"] > 15


def test_the_notebook_is_whole() -> None:
    """It holds no output, so that its pictures cannot become stale, and each cell compiles."""
    notebook = json.loads((DOCS / "notebook.ipynb").read_text())
    assert notebook["nbformat"] == 4
    code = [cell for cell in notebook["cells"] if cell["cell_type"] == "code"]
    assert len(code) > 4
    for cell in code:
        assert cell["outputs"] == []
        compile("".join(cell["source"]), "notebook.ipynb", "exec")


def defined(page: str, mark: str) -> ModuleType:
    """The module that a page's only block of this mark is."""
    (text,) = blocks(page, mark)
    module = ModuleType(f"docs_{mark}")
    exec(compile(text, page, "exec"), module.__dict__)
    return module


def test_the_encoder_of_the_architecture_page_is_one() -> None:
    encoder = defined("architecture.md", "encoder").make(None)
    assert isinstance(encoder, Encoder)
    cameras = Cameras(torch.eye(4).repeat(2, 1, 1), torch.eye(3).repeat(2, 1, 1) * 40, 12, 18)
    views = Views(torch.rand(2, 3, 12, 18), torch.ones(2, 12, 18, dtype=torch.bool), ("a", "b"), ((12, 18),) * 2)
    posed = PosedViews(views, cameras, torch.zeros(0, 3), (torch.zeros(0, dtype=torch.long),) * 2)
    geometry = encoder.estimate_geometry(posed, seed=0, progress=lambda text, fraction: None)
    assert geometry.depth.shape == (2, 12, 18)
    assert geometry.features[0].shape == (2, 2 * 3, FEATURE_CHANNELS)


@pytest.fixture
def points(monkeypatch: pytest.MonkeyPatch) -> str:
    """The splatter of the architecture page, registered as the page says."""
    monkeypatch.setattr(render_module, "BACKENDS", replace(BACKENDS, _registered={}))
    querysplat_cli.register_splatter("points", defined("architecture.md", "splatter").blend)
    return "points"


def test_the_splatter_of_the_architecture_page_is_one(points: str) -> None:
    """Two Gaussians on one pixel, the nearer of them listed last, and one behind the camera."""
    gaussians = Gaussians(
        torch.tensor([[0.0, 0, 5], [0, 0, 4], [0, 0, -4]]),
        torch.tensor([[1.0, 0, 0, 0]]).repeat(3, 1),
        torch.full((3, 3), 0.1),
        torch.full((3,), 0.9),
        torch.tensor([[[1.0, 0, 0]], [[0, 1.0, 0]], [[0, 0, 1.0]]]),
    )
    K = torch.tensor([[[20.0, 0, 8], [0, 20, 6], [0, 0, 1]]])
    found = render(gaussians, Cameras(torch.eye(4)[None], K, 12, 16), backend=points)
    assert found.depth[0, 6, 8] == 4
    assert found.colour[0, :, 6, 8].tolist() == pytest.approx([0.5, 0.5 + 0.2820948, 0.5])
    assert found.alpha.sum() == 1
