"""`querysplat tto`: optimise a stored scene further."""

from time import perf_counter

from querysplat_cli.cli.verb import Printing
from querysplat_cli.commands.requests import Watching
from querysplat_cli.pipeline.resume_settings import ResumeSettings
from querysplat_cli.scene.files import with_name


def tto(settings: ResumeSettings, printing: Printing, watching: Watching) -> None:
    """Optimise a stored scene further on its photos, and update its .ply, folder and report.

    Ctrl-C ends the optimisation and keeps what it has reached.
    """
    started = perf_counter()
    from querysplat_cli.cli.print_report import exit_if_interrupted, print_report
    from querysplat_cli.cli.watching import watching_stages
    from querysplat_cli.pipeline.resume import optimise_scene

    with watching_stages(watching, printing, with_name(settings.scene).stem, started=started) as stages:
        report = optimise_scene(settings, stages)
    print_report(report, printing)
    exit_if_interrupted(report)
