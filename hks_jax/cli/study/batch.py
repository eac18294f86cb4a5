"""Compute the signatures of many subjects, and tables of their regions.

Compute the signatures of many subjects at the same times, and tables of their regions. SUBJECTS is a table (.tsv or
.csv) with a row for each subject and the columns

  participant_id   sub-01 or 01
  session_id       ses-1 or 1, optional
  file             tensors, or diffusion-weighted images; or one of six images of components
  {files}
                   more files of the subject, optional; paths are relative to the table's folder
  {columns}
                   options that differ between subjects, optional; paths of noise are relative to the table's folder

Other columns, such as age and group, are copied to participants.tsv. The values in a row replace the values of the
command's options.

DIR becomes a BIDS derivative. For each subject, DIR contains an image with its sidecar, an .npz for hks-jax explore,
plot and stats, a picture, and with --atlas a table of regions. The tables group_summary.tsv and group_regions.tsv
contain all subjects.

If the mean diffusivity of a subject, in mm2/s, is outside the range of living tissue, the subject fails until --unit or
a column named unit gives the unit, because subjects with different units cannot be compared.

If a subject fails, the others are still computed. If the command is repeated, it computes only the signatures and
tables that are missing, or whose input files have changed. A repeated command takes omitted options from the study.

examples:
  hks-jax batch subjects.tsv -o study --metric inverse --atlas atlas.nii.gz
  hks-jax batch subjects.tsv -o study --metric inverse --times 8e5 1.6e6 3.2e6 --only sub-07 sub-08
"""

import argparse
from pathlib import Path

from hks_jax.cli.combinations import refuse
from hks_jax.cli.parsing import folder
from hks_jax.cli.progress import Progress
from hks_jax.cli.study import settings
from hks_jax.cli.study.folder import written_in
from hks_jax.cli.study.subjects import Subject, read_subjects

USAGE = "SUBJECTS -o DIR"


def add_options(parser: argparse.ArgumentParser) -> None:
    """Add the options of the command."""
    parser.add_argument("subjects", type=Path, metavar="SUBJECTS", help="the table of subjects")
    parser.add_argument("-o", "--output", type=folder, required=True, metavar="DIR", help="the study's folder")
    settings.add_options(parser)
    parser.add_argument(
        "--replace", action="store_true", help="replace a study in DIR that has other settings or times"
    )
    parser.add_argument(
        "--only",
        nargs="+",
        metavar="SUBJECT",
        help="compute only these subjects, such as sub-07 or sub-07_ses-2, without the tables of all subjects, which "
        "the command without --only writes",
    )


def writes(args: argparse.Namespace) -> list[Path]:
    """Return the files that the command may write."""
    return written_in(args.output)


def run(args: argparse.Namespace, begun: Progress) -> None:
    """Run the command; if some subjects fail, raise ComputationError after computing the others."""
    from hks_jax.cli.study.tasks import run_study

    note = settings.complete(args)
    subjects = read_subjects(args.subjects, args)
    if not any(s.arguments is not None and s.arguments.atlas is not None for s in subjects):
        refuse(args, ("names",), "this option names labels, which are missing; pass --atlas, or a column named atlas")
    run_study(args, _only(subjects, args.only), lambda: subjects, begun, note, collects=args.only is None)


def _only(subjects: list[Subject], names: list[str] | None) -> list[Subject]:
    if names is None:
        return subjects
    wanted = {name if name.startswith("sub-") else f"sub-{name}" for name in names}
    chosen = [subject for subject in subjects if {subject.name, subject.participant} & wanted]
    missing = wanted - {name for subject in chosen for name in (subject.name, subject.participant)}
    if missing:
        raise ValueError(f"--only: got {', '.join(sorted(missing))}; expected names of subjects in the table")
    return chosen
