"""The packages that querysplat can do without: what each brings, and how to get it."""

from dataclasses import dataclass


@dataclass(frozen=True)
class OptionalPart:
    """An extra of the package. `module` is what is imported, `package` what is installed."""

    extra: str
    module: str
    package: str
    gives: str

    @property
    def command(self) -> str:
        """The command that installs it."""
        return install_command(self.extra)


def install_command(extra: str) -> str:
    """The command that installs an extra of the package."""
    return f"pip install 'querysplat[{extra}]'"


OPTIONAL_PARTS = (
    OptionalPart("heic", "pillow_heif", "pillow-heif", "HEIC photos, as phones write them"),
    OptionalPart("formats", "gsply", "gsply", "scenes as .spz"),
    OptionalPart("mesh", "skimage", "scikit-image", "scenes as meshes (convert --mesh)"),
    OptionalPart("mesh", "trimesh", "trimesh", "meshes as .ply, .glb and .obj (convert --mesh)"),
    OptionalPart("cuda", "gsplat", "gsplat", "rendering and optimisation on an NVIDIA GPU (--device cuda)"),
    OptionalPart("weights", "huggingface_hub", "huggingface_hub", "finding the official weights in the Hub's cache"),
    OptionalPart("matching", "kornia", "kornia", "networks that match photos from far apart (with weights: `weights`)"),
    OptionalPart("metrics", "flip_evaluator", "flip-evaluator", "FLIP in evaluations (eval --metrics flip)"),
    OptionalPart("metrics", "ssimulacra2", "ssimulacra2", "SSIMULACRA2 in evaluations (eval --metrics ssimulacra2)"),
    OptionalPart("cluster", "distributed", "distributed", "regions, cases and samples on several machines (--cluster)"),
    OptionalPart("cluster", "dask_jobqueue", "dask-jobqueue", "the same in jobs of Slurm (--cluster slurm:N)"),
    OptionalPart("cluster", "bokeh", "bokeh", "Dask's page, which shows the work of a cluster"),
    OptionalPart("tensorboard", "tensorboard", "tensorboard", "TensorBoard's files of a training (--tensorboard)"),
)
"""One row for each package of the extras of pyproject.toml that are for users."""
