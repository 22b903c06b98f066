"""The views of a scene without near-duplicates."""

from querysplat_cli.encoders.base import PosedViews
from querysplat_cli.encoders.holdout import select_views
from querysplat_cli.prune.views import near_duplicates
from querysplat_cli.scene.views import LeftOut


def duplicates(posed: PosedViews, *, keep_all: bool) -> dict[int, int]:
    """The row of each near-duplicate and of the view that shows the same; `keep_all` finds none."""
    return {} if keep_all else near_duplicates(posed.cameras, posed.points, posed.visibility)


def distinct_views(posed: PosedViews, *, keep_all: bool) -> tuple[PosedViews, tuple[LeftOut, ...]]:
    """The views without near-duplicates, and the near-duplicates, of which `keep_all` leaves none out."""
    names, same = posed.views.names, duplicates(posed, keep_all=keep_all)
    if not same:
        return posed, ()  # the same object: encoders and memos recognise the views of their own pass by it
    left_out = tuple(LeftOut(names[view], f"shows what {names[other]} shows") for view, other in same.items())
    return select_views(posed, [view for view in range(len(names)) if view not in same]), left_out
