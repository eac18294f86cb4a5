"""Compute the signatures of a BIDS dataset's participants, as a BIDS app.

Compute the signatures of the participants in BIDS_DIR: a folder of derivatives (QSIRecon, QSIPrep, FSL, MRtrix), or a
BIDS dataset with such folders in derivatives/. The input of a result is an image of tensors, or six images of their
components, or else preprocessed diffusion-weighted images, to which tensors are fitted. Each combination of the
entities ses-, acq-, dir-, run-, space- … in their names is a result of its own, which has these entities in its name.

--mask and --atlas take a file for all participants, or entities that select a file of each participant on the voxels of
the input, such as desc-brain or seg-4S156Parcels. Without --mask, a mask desc-brain is used if there is one.

LEVEL is one of

  prepare      choose the settings and the times that suit all participants, and store them in OUT
  participant  compute the signatures of the participants that are not done. If OUT has no settings yet, the command
               begins with prepare. Jobs for different participants may run at once
  group        collect the tables group_summary.tsv, group_regions.tsv and participants.tsv of all participants

OUT becomes a BIDS derivative, which 'hks-jax batch' describes. A repeated command takes omitted options from OUT, and
computes only results that are missing, damaged, or of changed files. OUT/logs has a log for each result.

examples:
  hks-jax bids derivatives/qsirecon-DSIStudio out prepare --metric inverse --times 8e5 1.6e6 3.2e6
  hks-jax bids derivatives/qsirecon-DSIStudio out participant --participant-label 01 02
  hks-jax bids derivatives/qsirecon-DSIStudio out group
"""

import argparse
import copy
from pathlib import Path

from hks_jax.accuracy import warn_of_accuracy
from hks_jax.cli.combinations import refuse
from hks_jax.cli.parsing import folder
from hks_jax.cli.progress import Progress
from hks_jax.cli.study import settings
from hks_jax.cli.study.folder import written_in
from hks_jax.cli.study.subjects import Subject
from hks_jax.io.bids import Dataset, Source, are_entities, kept, parse_entities
from hks_jax.io.nifti import component_of, declared_in, is_nifti

USAGE = "BIDS_DIR OUT LEVEL"
_BRAIN = {"desc": "brain", "label": "brain"}
"""The entities of the usual masks; other labels are those of lesions or tissues."""


def add_options(parser: argparse.ArgumentParser) -> None:
    """Add the options of the command."""
    parser.add_argument(
        "bids_dir", metavar="BIDS_DIR", help="folder of derivatives, or a BIDS dataset with derivatives"
    )
    parser.add_argument("output", type=folder, metavar="OUT", help="folder for the results")
    parser.add_argument(
        "level",
        choices=("prepare", "participant", "group"),
        metavar="LEVEL",
        help="level of the analysis: prepare, participant or group",
    )
    parser.add_argument(
        *("--participant-label", "--participant_label"),
        nargs="+",
        metavar="LABEL",
        help="compute only these participants, such as 01 or sub-01",
    )
    parser.add_argument(
        "--select",
        metavar="ENTITIES",
        help="use only inputs with these entities, such as space-ACPC or ses-1_desc-preproc",
    )
    parser.add_argument(
        *("--skip-bids-validation", "--skip_bids_validation"),
        action="store_true",
        help="accepted as by other BIDS apps; the dataset is never validated",
    )
    settings.add_options(parser)
    parser.add_argument(
        "--replace", action="store_true", help="replace results in OUT that have other settings or times"
    )


def writes(args: argparse.Namespace) -> list[Path]:
    """Return the files that the command may write."""
    return written_in(args.output)


def run(args: argparse.Namespace, begun: Progress) -> None:
    """Run the command; if some subjects fail, raise ComputationError after computing the others."""
    from hks_jax.cli.study.tasks import collect, prepare, run_study

    if args.level != "participant" and args.participant_label is not None:
        raise ValueError(f"--participant-label: got the level {args.level}, which is for all; leave the option out")
    note, dataset = settings.complete(args), Dataset(Path(args.bids_dir), args.output)
    refuse(args, ("names",) * (args.atlas is None), "this option names labels, which are missing; pass --atlas")
    chosen = dataset.chosen(args.participant_label)
    subjects = find_subjects(dataset, chosen, args)
    if args.replace or not (args.output / "study.json").is_file():
        _require_used(args, _all(dataset, subjects, args) if args.participant_label else subjects)
    if args.level != "participant":
        (collect if args.level == "group" else prepare)(args, subjects, begun, note)
    else:
        run_study(args, subjects, lambda: _all(dataset, subjects, args), begun, note, collects=False)


def _require_used(args: argparse.Namespace, subjects: list[Subject]) -> None:
    """Raise ValueError for options of images if no participant has images, and of tensors if all have images."""
    of_images = [subject.arguments.bval is not None for subject in subjects if subject.arguments is not None]
    if not any(of_images):
        why = "this option is for diffusion-weighted images, but all participants have tensors; leave it out"
        refuse(args, ("bval", "bvec", "b_max", "bvec_frame"), why)
    elif all(of_images):
        why = "this option is for tensors, but all participants have diffusion-weighted images; see --bvec-frame"
        refuse(args, ("frame", "order"), why)


def _all(dataset: Dataset, subjects: list[Subject], args: argparse.Namespace) -> list[Subject]:
    others = set(dataset.participants) - {subject.entities["sub"] for subject in subjects}
    return subjects + find_subjects(dataset, sorted(others), args)


def find_subjects(dataset: Dataset, participants: list[str], args: argparse.Namespace) -> list[Subject]:
    """Find the inputs of participants.

    A participant without inputs, or with ambiguous inputs, becomes a subject with a problem. If all participants have
    problems, the function raises ValueError with the first.
    """
    covariates, subjects = dataset.covariates(), list[Subject]()
    wanted = _wanted(args.select, "--select")
    for label in participants:
        of = covariates.get(f"sub-{label}", {})
        try:
            for source in dataset.sources(label, wanted):
                arguments = _arguments(dataset, source, args)
                subjects.append(Subject(kept(source.file.name.entities), arguments, "", of))
        except (ValueError, FileNotFoundError) as error:
            subjects = [subject for subject in subjects if subject.entities["sub"] != label]
            subjects.append(Subject({"sub": label}, None, str(error), of))
    if subjects and not any(subject.arguments for subject in subjects):
        raise ValueError(subjects[0].problem)
    if args.mask is None:
        _tell_of_masks(dataset, subjects)
    return subjects


def _tell_of_masks(dataset: Dataset, subjects: list[Subject]) -> None:
    """Warn of subjects without a mask, unless no participant has one."""
    found = [subject for subject in subjects if subject.arguments is not None]
    lacking = [subject for subject in found if subject.args.mask is None]
    unused = [mask for subject in lacking for mask in dataset.masks(subject.entities["sub"])]
    if lacking and (unused or len(lacking) < len(found)):
        why = f". {unused[0]} is not used, because its space or label differs" if unused else ""
        warn_of_accuracy(
            f"--mask: {len(lacking)} of {len(found)} inputs have no mask desc-brain with their voxels (the first is "
            f"{lacking[0].name}), so their domain is the whole image{why}. Pass --mask",
            UserWarning,
        )


def _arguments(dataset: Dataset, source: Source, args: argparse.Namespace) -> argparse.Namespace:
    """Return the command's arguments with the files of an input."""
    own = copy.copy(args)
    own.file, own.others = source.file.path, []
    for name, suffix, usual in (("mask", "mask", _BRAIN), ("atlas", "dseg", {})):
        given = getattr(args, name)
        by_entities = given is not None and are_entities(str(given))
        if by_entities or (given is None and name == "mask"):
            entities = _wanted(given, f"--{name}")
            setattr(own, name, dataset.companion(source.file, suffix, entities, usual, f"--{name}"))
    if source.bval is not None:
        own.bval, own.bvec = args.bval or source.bval, args.bvec or source.bvec
        own.frame = own.order = None
    else:
        own.bval = own.bvec = own.bvec_frame = own.b_max = None
        inherited = declared_in(dataset.inherited(source.file))
        whole = is_nifti(source.file.path) and component_of(source.file.path) is None
        own.order = args.order or source.order or (inherited.order if whole else None)
        own.frame, own.unit = args.frame or inherited.frame, args.unit or inherited.unit
    return own


def _wanted(text: Path | str | None, option: str) -> dict[str, str]:
    try:
        return {} if text is None else parse_entities(str(text))
    except ValueError as error:
        raise ValueError(f"{option}: {error}") from error
