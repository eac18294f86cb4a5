"""The subjects of a study, and the table from which they are read, whose rows contain files and options."""

import argparse
import copy
import re
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import NoReturn

from hks_jax.cli.combinations import require_noise_options
from hks_jax.cli.options import COLUMNS, FILES, add_atlas, add_file, add_names, add_noise, add_reading
from hks_jax.cli.reading import is_file
from hks_jax.io.bids import format_entities
from hks_jax.io.tables import read_table


@dataclass(frozen=True)
class Subject:
    """The input of one result: a row of the table, or tensors in a BIDS dataset.

    Attributes:
        entities: the BIDS entities in the names of the result, from ``sub`` on.
        arguments: the arguments of the command, some replaced by values of the subject; None if these are invalid.
        problem: the error message if the arguments are invalid; otherwise empty.
        covariates: the participant's columns that are not arguments.
    """

    entities: Mapping[str, str]
    arguments: argparse.Namespace | None
    problem: str = ""
    covariates: Mapping[str, str] = field(default_factory=dict)

    @property
    def args(self) -> argparse.Namespace:
        """The arguments; raises ValueError if they are invalid."""
        if self.arguments is None:
            raise ValueError(self.problem)
        return self.arguments

    @property
    def name(self) -> str:
        """The prefix of the subject's file names, such as ``sub-01`` or ``sub-01_ses-2_run-1``."""
        return format_entities(self.entities)

    @property
    def participant(self) -> str:
        """``sub-`` and the participant's label."""
        return f"sub-{self.entities['sub']}"

    @property
    def folder(self) -> Path:
        """The subject's folder, relative to the folder of the study."""
        return Path(*(f"{entity}-{self.entities[entity]}" for entity in ("sub", "ses") if entity in self.entities))


class _RowParser(argparse.ArgumentParser):
    def error(self, message: str) -> NoReturn:
        raise ValueError(message)


def read_subjects(path: Path, common: argparse.Namespace) -> list[Subject]:
    """Read the table; for each subject, replace arguments of the command by values in the row.

    A row with invalid options becomes a subject with a problem. The function raises ValueError for a missing
    `participant_id`, for a label that BIDS does not allow, and for a duplicate subject and session.
    """
    rows, parser = read_table(path), _RowParser(add_help=False)
    for add in (add_file, add_reading, add_noise, add_atlas, add_names):
        add(parser)
    subjects: dict[str, Subject] = {}
    if not any("participant_id" in row for row in rows):
        names = ", ".join(dict.fromkeys(name for row in rows for name in row))
        raise ValueError(f"{path}: got the columns {names or 'none'}; expected a column named participant_id")
    for number, row in enumerate(rows, 2):
        if "participant_id" not in row:
            raise ValueError(f"{path}: got no participant_id in row {number}; expected one in every row")
        columns = {"sub": "participant_id", "ses": "session_id"}
        entities = {e: _label(path, e, row.pop(column)) for e, column in columns.items() if column in row}
        words, covariates = _words(path.parent, row)
        try:
            if not words or words[0].startswith("--"):
                raise ValueError("got no file; expected a file in every row")
            arguments, problem = parser.parse_args(words, copy.copy(common)), ""
            if "--draws" in words:  # of the row, not of all subjects
                require_noise_options(arguments)
            if is_file(arguments.noise):
                arguments.noise = str(path.parent / arguments.noise)
        except ValueError as error:
            arguments, problem = None, str(error)
        subject = Subject(entities, arguments, problem, covariates)
        if subject.name in subjects:
            raise ValueError(f"{path}: got two rows for {subject.name}. Distinguish them by a column named session_id")
        subjects[subject.name] = subject
    return list(subjects.values())


def _label(path: Path, entity: str, text: str) -> str:
    label = text.removeprefix(f"{entity}-")
    if not re.fullmatch("[A-Za-z0-9]+", label):
        raise ValueError(f"{path}: got {text!r}; expected {entity}-LABEL or LABEL with only letters and digits (BIDS)")
    return label


def _words(folder: Path, row: dict[str, str]) -> tuple[list[str], dict[str, str]]:
    """Return a row's options, as words of a command line, and its other columns."""
    words, covariates = [], {}
    if "file" in row:
        words.append(str(folder / row.pop("file")))
    for column, text in row.items():
        option = column.lower().replace("_", "-")
        if option in FILES:
            words += [f"--{option}", str(folder / text)]
        elif option in COLUMNS:
            words += [f"--{option}", *(text.replace(",", " ").split() if option == "spacing" else [text])]
        else:
            covariates[column] = text
    return words, covariates
