"""How the field of a dataclass appears on the command line, and the fields that several verbs share.

A field is declared once: its name, type and default by the dataclass, its help by an `Option` in `Annotated`, its
bounds by `annotated_types`. Nothing here needs torch, so `--help` is quick.
"""

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

from annotated_types import Ge

from querysplat_cli.runtime.choices import Amount, Precision
from querysplat_cli.runtime.cluster import read_cluster


@dataclass(frozen=True)
class Option:
    """What the help of a field says, and how its text is read.

    `names` replace the name that follows from the field's, such as --max-size from max_size. `default` describes the
    default where its value says too little. `auto` reads the word "auto" as None. An `argument` has no name; a
    `repeated` option may be given several times, while other tuples are separated by commas. `parse` reads text that no
    type describes; it raises QuerySplatError.
    """

    help: str
    names: tuple[str, ...] = ()
    metavar: str | None = None
    default: str | None = None
    auto: bool = False
    argument: bool = False
    repeated: bool = False
    parse: Callable[[str], Any] | None = None


@dataclass(frozen=True, init=False)
class Only:
    """The fields of a dataclass that a verb offers as options, and the values of fields that it decides itself."""

    names: tuple[str, ...]
    fixed: dict[str, Any]

    def __init__(self, *names: str, **fixed: Any) -> None:
        object.__setattr__(self, "names", names)
        object.__setattr__(self, "fixed", fixed)


StoredScenePath = Annotated[
    Path, Option("The folder that `reconstruct` wrote, or the file of Gaussians beside it.", argument=True)
]
Seed = Annotated[
    int,
    Ge(0),
    Option("The seed of every random choice. The same seed on the same machine gives the same file.", metavar="N"),
]
Force = Annotated[bool, Option("Replace files that exist already.")]
Device = Annotated[
    str, Option("Where to compute. auto is cuda where a GPU and gsplat are there.", metavar="auto|cpu|cuda")
]
Weights = Annotated[
    Path | None,
    Option("The folder of downloaded weights.", metavar="DIR", default="the Hugging Face cache"),
]
MovedWeights = Annotated[
    Path | None,
    Option("The folder of downloaded weights, if it has moved.", metavar="DIR", default="where it was"),
]
LpipsWeights = Annotated[
    Path | None,
    Option("A folder with LPIPS weights; docs/cli.md lists the files.", metavar="DIR", default="torch's hub cache"),
]
NetworkPrecision = Annotated[Precision, Option("The number format of the networks' matrix products.")]
Prune = Annotated[
    Amount,
    Ge(1),
    Option(
        "Gaussians to keep. auto leaves out the half whose absence changes the pictures least; "
        "off keeps all; N keeps at most N, beside the backdrop.",
        metavar="auto|off|N",
    ),
]
Cluster = Annotated[
    str | None,
    Option(
        "Let Dask make the regions, cases or samples: in N processes of this machine, on the workers of a scheduler, "
        "or in N jobs of Slurm. Needs the extra `cluster`.",
        metavar="local:N|tcp://HOST:PORT|slurm:N",
        default="this machine, without Dask",
        parse=read_cluster,
    ),
]
