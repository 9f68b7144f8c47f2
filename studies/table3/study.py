"""Table 3 of the paper: the 32 cells beside IDA and Exudyn; with --full also the other solvers and readings."""

from collections.abc import Sequence
from dataclasses import replace

from studies.bench import cli
from studies.bench.index import write_index
from studies.bench.store import Output
from studies.bench.study import saved
from studies.table3 import cells, full

FOLDER = "given_lengths"  # in reports/, for another geometry: the reports there are of the assumed one


def main(words: Sequence[str] | None = None) -> None:
    """Run the study for a command line."""

    def inside(words: Sequence[str] | None) -> None:
        parser = cli.parser("table3", __doc__, parts=True)
        parser.add_argument("--full", action="store_true", help="the long study, into table3_full.*: about 20 minutes")
        parser.add_argument("--lengths", nargs=3, type=float, metavar=("L1", "L2", "L3"), help="of the bars, m")
        parser.add_argument("--ground", type=float, metavar="G", help="distance of the ground joints, m")
        given = parser.parse_args(words)
        geometry = cells.geometry_of(given.lengths, given.ground)
        if geometry is not None and given.full:
            raise cli.StudyError("--full is for the assumed geometry; leave it out with --lengths")
        if geometry is not None and given.out is None:
            given.out = cli.REPORTS / FOLDER
        call = cli.call_of("table3", given, words)
        study = full.STUDY if given.full else cells.study_of(geometry)
        with Output(replace(call, study=study.name)) as output:
            study.report(output, *saved(output, study.make))
            write_index(output)
        print(f"wrote the files of {study.name} to {output.path}")

    cli.main(inside, words)
