"""`querysplat eval`: methods on one scale."""

from querysplat_cli.cli.verb import Printing
from querysplat_cli.evaluation.request import EvalRequest
from querysplat_cli.runtime import signals
from querysplat_cli.runtime.colmap import load_pycolmap


def evaluate(request: EvalRequest, printing: Printing) -> None:
    """Score scenes by the paper's protocol.

    Input, interpolation and extrapolation views are scored apart.
    """
    load_pycolmap()
    from querysplat_cli.cli.print_evaluation import print_evaluation
    from querysplat_cli.cli.terminal import say, showing_stages
    from querysplat_cli.evaluation.results import has_results
    from querysplat_cli.evaluation.run import evaluate as run
    from querysplat_cli.evaluation.shards import merge
    from querysplat_cli.evaluation.summary import summarise
    from querysplat_cli.evaluation.sweep import write_curves

    if request.merge:
        merge(request.scenes, request.out)
        print_evaluation(summarise(request.out), request.out, printing)
        return
    try:
        with showing_stages(printing) as stages:
            summary = run(request, stages, lambda text: say(text, printing))
    except KeyboardInterrupt:
        if has_results(request.out):
            signals.keep(f"Finished cases are in {request.out}, and the same command goes on with the others.")
        raise
    print_evaluation(summary, request.out, printing)
    if request.sweep and not request.splits_only:
        write_curves(request.out)
