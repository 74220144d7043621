"""Write docs/validation/consistency.md: NEES and coverage for the nominal scenario of every method.

python -m benchmarks.consistency --runs 200 --work consistency
"""

from __future__ import annotations

import sys
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Annotated

import typer

from alidade.pipelines import methods as known
from alidade.pipelines import progress
from alidade.pipelines.applications.fleet import statistics
from alidade.pipelines.applications.fleet.montecarlo import SOLVERS, Study, run_study
from alidade.pipelines.errors import InputError

# Seeds by which the studies of the incremental solver grow together.
_BLOCK = 25

# What follows this line on the page is kept.
_END = "<!-- End of the study -->"

_HEAD = """# Are the sigmas right? NEES and coverage

This page shows that errors are as large as the sigmas: each method's nominal scenario, simulated with seeds 0, 1, 2,
... and solved by all three solvers.

NEES is the squared estimation error in units of the joint covariance; its mean over many runs is the number of
parameters if the covariance is right. The interval contains the mean in 99 of 100 studies. Coverage is the share of
errors within 1, 2 and 3 sigmas: 68.3, 95.4 and 99.7 % for normal errors. Covariances of the published solvers are those
of their own linearised models.

Reproduce: `python -m benchmarks.consistency --runs {runs}`, which resumes after an interruption. One study with
histograms: `alidade montecarlo METHOD`.

| method | solver | runs | parameters | mean NEES | 99 % interval | inside | within 1, 2, 3 sigmas, % |
| --- | --- | --- | --- | --- | --- | --- | --- |
"""


def main(
    runs: Annotated[int, typer.Option(help="Simulated recordings a method.")] = 200,
    methods: Annotated[str, typer.Option(help="Some of the methods; by default all.")] = ",".join(known.names()),
    scheduler: Annotated[str | None, typer.Option(help="Of a dask cluster; default: this machine.")] = None,
    jobs: Annotated[int | None, typer.Option(help="Local worker processes; default: one a core.")] = None,
    work: Annotated[Path, typer.Option(help="Folder for what is finished.")] = Path("consistency"),
    out: Annotated[Path, typer.Option(help="The page to write.")] = Path("docs/validation/consistency.md"),
) -> None:
    """Run the studies and write the page; Ctrl-C ends it with what is finished."""
    studies: dict[tuple[str, str], Study] = {}
    interrupted = False
    for method, solvers, stop in _plan(methods.split(","), runs):
        folder = work / method / "-".join(solvers)
        with progress.shown():
            study = run_study(method, None, range(stop), solvers, folder, scheduler, jobs)
        studies |= {(method, solver): study for solver in solvers}
        interrupted = study.interrupted
        if interrupted:
            break
    order = [(method, solver) for method in methods.split(",") for solver in SOLVERS]
    written = page([(solver, studies[m, solver]) for m, solver in order if (m, solver) in studies], runs)
    kept = out.read_text("utf-8").partition(_END)[2] if out.exists() else "\n"
    out.write_text(f"{written}\n{_END}{kept}", "utf-8")
    if interrupted:
        raise InputError(f"interrupted, {out} shows what is finished; the same command continues")


def _plan(methods: Sequence[str], runs: int) -> Iterator[tuple[str, tuple[str, ...], int]]:
    """Method, solvers and number of seeds of each study: first what is quick, then the incremental solver, which takes
    ten times as long, in blocks that leave all methods with as many runs when interrupted."""
    for method in methods:
        yield method, SOLVERS[:2], runs
    for stop in [*range(_BLOCK, runs, _BLOCK), runs]:
        for method in methods:
            yield method, SOLVERS[2:], stop


def page(studies: Sequence[tuple[str, Study]], runs: int) -> str:
    """The page as Markdown, from solvers each with the study that has its results."""
    text = _HEAD.format(runs=runs) + "".join(_row(study, solver) for solver, study in studies)
    failures = [
        f"- {study.method}, {solver}, seed {seed}: {reason}\n"
        for solver, study in studies
        for seed, reason in study.failures(solver).items()
    ]
    return text + ("\nRuns without an estimate:\n\n" + "".join(failures) if failures else "")


def _row(study: Study, solver: str) -> str:
    if not study.estimates(solver):
        return f"| {study.method} | {solver} | 0 | | | | | |\n"
    nees = study.nees(solver)
    shares = ", ".join(f"{100.0 * share:.1f}" for share in statistics.coverage(study.normalised(solver)))
    interval = f"{nees.low:.3f} to {nees.high:.3f} | {'yes' if nees.consistent else '**no**'}"
    return f"| {study.method} | {solver} | {nees.runs} | {nees.dof:g} | {nees.mean:.4g} | {interval} | {shares} |\n"


if __name__ == "__main__":
    try:
        typer.run(main)
    except InputError as error:
        sys.exit(f"alidade: {error}")
