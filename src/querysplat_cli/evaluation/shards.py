"""The results of several runs become those of one."""

import shutil
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from querysplat_cli.evaluation.results import (
    RowFolder,
    check_same_settings,
    open_row_folder,
    read_json,
    row_folders,
)
from querysplat_cli.evaluation.summary import summarise_row
from querysplat_cli.runtime.errors import QuerySplatError
from querysplat_cli.scene.files import atomic_folder


def merge(parts: Sequence[Path], out: Path) -> None:
    """Copy the results of several runs, for instance the shards of one, into `out`.

    A case that several parts have is taken from the first that scored it. Nothing is copied before everything was read:
    raises QuerySplatError when a part has no results or damaged ones, or two have different settings for one row and
    split.
    """
    found = [row_folder for part in parts for row_folder in _checked(part)]
    targets = [RowFolder(out, row_folder.row, row_folder.split) for row_folder in found]
    settings: dict[Path, dict[str, Any]] = {}
    for source, target in zip(found, targets, strict=True):
        config, file = read_json(source.path / "run_config.json"), target.path / "run_config.json"
        before = settings.setdefault(target.path, read_json(file) if file.is_file() else config)
        check_same_settings(source.path, before, config)
    for source, target in zip(found, targets, strict=True):
        open_row_folder(target, settings[target.path], force=False)
        for case in sorted(entry for entry in source.path.iterdir() if entry.is_dir()):
            if not case.name.startswith(".") and not target.is_done(case.name):
                with atomic_folder(target.case(case.name)) as draft:
                    shutil.copytree(case, draft, dirs_exist_ok=True)


def _checked(part: Path) -> list[RowFolder]:
    found = row_folders(part)
    if not found:
        raise QuerySplatError(f"{part}: no results of `querysplat eval` in it", "Give the folders of the shards.")
    for row_folder in found:
        summarise_row(row_folder)
    return found
