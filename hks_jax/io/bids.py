"""Find the tensors, diffusion-weighted images, masks and labels of a BIDS derivative by the entities in their names.

Tensors follow the draft of BIDS for diffusion derivatives (BIDS Extension Proposal 16, as of September 2025), or the
names that QSIRecon, FSL's dtifit and MRtrix's dwi2tensor write.
"""

import re
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Any, NamedTuple

from hks_jax.io.json_files import read_json
from hks_jax.io.nifti import sidecar_of
from hks_jax.io.tables import read_table
from hks_jax.io.tensor_order import Order

CONTENT = ("model", "param", "desc", "label", "seg", "atlas", "fit", "bundles")
"""Entities that describe the content of a file. Results keep all other entities of their input in their names."""
_NIFTI = ("nii", "nii.gz")
_IMAGES = (*_NIFTI, "mif", "mif.gz")
_PAIR = re.compile(r"([a-z]+)-([A-Za-z0-9+]+)")
_SHOWN = 20
"""The number of participants that a message lists."""


@dataclass(frozen=True)
class Name:
    """The parts of a file's name: the entities in order, the rest as suffix, and the extension without its dot.

    Examples:
        >>> from hks_jax.io.bids import parse_name
        >>> name = parse_name("sub-01/ses-2/dwi/sub-01_ses-2_space-ACPC_model-tensor_param-txx_dwimap.nii.gz")
        >>> print(name.source, name.suffix, name.extension)
        sub-01_ses-2_space-ACPC dwimap nii.gz
    """

    entities: Mapping[str, str]
    suffix: str
    extension: str

    @property
    def source(self) -> str:
        """The entities that results keep, as a text."""
        return format_entities(kept(self.entities))

    def label(self, entity: str) -> str:
        """Return the label of an entity in lower case; empty if the name lacks the entity."""
        return self.entities.get(entity, "").lower()


def parse_name(path: str | Path) -> Name:
    """Return the parts of a name; a participant or session that the name lacks is taken from the folders."""
    *folders, name = Path(path).parts
    stem, _, extension = name.partition(".")
    words = stem.split("_")
    places = [folder for folder in folders if folder.startswith(("sub-", "ses-"))]
    entities = {pair[1]: pair[2] for word in (*places, *words) if (pair := _PAIR.fullmatch(word))}
    return Name(entities, "_".join(word for word in words if not _PAIR.fullmatch(word)), extension)


def format_entities(entities: Mapping[str, str]) -> str:
    """Return entities as in the name of a file."""
    return "_".join(f"{entity}-{label}" for entity, label in entities.items())


def kept(entities: Mapping[str, str]) -> dict[str, str]:
    """Return the entities that results keep."""
    return {entity: label for entity, label in entities.items() if entity not in CONTENT}


def parse_entities(text: str) -> dict[str, str]:
    """Return the labels by entity in a text such as ``space-ACPC`` or ``run-1_desc-preproc``."""
    pairs = [_PAIR.fullmatch(word) for word in text.split("_")]
    if None in pairs:
        raise ValueError(f"got {text!r}; expected entities and labels, such as space-ACPC or run-1_desc-preproc")
    return {pair[1]: pair[2] for pair in pairs if pair}


def are_entities(text: str) -> bool:
    """Return whether a text, such as ``space-ACPC_desc-brain``, consists of entities only."""
    return all(_PAIR.fullmatch(word) for word in text.split("_"))


class Kind(NamedTuple):
    """A kind of input: its names in words, its test, and the order of its components if the program is known."""

    names: str
    matches: Callable[[Name], bool]
    order: Order | None = None


def _is_model(name: Name, *params: str) -> bool:
    return name.suffix == "dwimap" and name.label("model") in ("tensor", "dti") and name.label("param") in params


TENSORS = (
    Kind(
        "*_model-tensor[_param-tensor|diffusivity]_dwimap.nii[.gz] or .mif[.gz] (also model-DTI)",
        lambda name: name.extension in _IMAGES and _is_model(name, "", "tensor", "diffusivity"),
    ),
    Kind(
        "*_model-tensor_param-txx_dwimap.nii[.gz] with the five other components (QSIRecon)",
        lambda name: name.extension in _NIFTI and _is_model(name, "txx", "dxx"),
    ),
    Kind(
        "*_tensor.nii[.gz] (dtifit --save_tensor)",
        lambda name: name.extension in _NIFTI and re.fullmatch("(.*_)?tensor", name.suffix) is not None,
        "fsl",
    ),
    Kind(
        "*_dt.mif[.gz], *_tensor.mif[.gz] (dwi2tensor)",
        lambda name: name.extension in ("mif", "mif.gz") and re.fullmatch("(.*_)?(dt|tensor)", name.suffix) is not None,
    ),
)
IMAGES = (
    Kind(
        "*_dwi.nii[.gz] with .bval and .bvec, if there are no tensors with these entities (QSIPrep)",
        lambda name: name.extension in _NIFTI and name.suffix == "dwi",
    ),
)


class File(NamedTuple):
    """A file, its parsed name, and the folder of its derivative."""

    path: Path
    name: Name
    root: Path


class Source(NamedTuple):
    """The input of one result.

    Attributes:
        file: tensors, one of six images of components, or diffusion-weighted images.
        order: the order of the components if the program that wrote them is known.
        bval: the b-values of diffusion-weighted images, or None.
        bvec: the gradient directions, or None.
    """

    file: File
    order: Order | None
    bval: Path | None = None
    bvec: Path | None = None


@dataclass(frozen=True)
class Dataset:
    """A folder of derivatives, or a BIDS dataset with folders of derivatives in ``derivatives/``.

    Attributes:
        folder: the folder.
        out: the folder of results, which is not searched.
    """

    folder: Path
    out: Path | None = None
    _files: dict[str, list[File]] = field(default_factory=dict, compare=False)

    @cached_property
    def roots(self) -> list[Path]:
        """The folders of derivatives that have participants. Raises ValueError if there are none."""
        if not self.folder.is_dir():
            raise FileNotFoundError(f"{self.folder}: no such folder; expected a BIDS dataset or its derivatives")
        found, raw = list[Path](), list[Path]()
        for folder in _with_derivatives(self.folder):
            if any(folder.glob("sub-*/")) and not (self.out and self.out.exists() and folder.samefile(self.out)):
                (raw if _is_raw(folder) else found).append(folder)
        if found:
            return found
        if raw:
            raise ValueError(
                f"{self.folder}: this is a raw dataset, whose images need preprocessing; expected derivatives, in "
                f"{self.folder} or in {self.folder / 'derivatives'}. Run QSIPrep first, for example"
            )
        raise ValueError(f"{self.folder}: got no folders sub-*; expected a BIDS dataset or its derivatives")

    @property
    def participants(self) -> list[str]:
        """The labels of the participants."""
        names = {path.name for root in self.roots for path in root.glob("sub-*/")}
        return sorted(name.removeprefix("sub-") for name in names if _PAIR.fullmatch(name))

    def chosen(self, labels: Iterable[str] | None) -> list[str]:
        """Return labels without ``sub-``, all if None; raise ValueError for participants that do not exist."""
        known = self.participants
        wanted = known if labels is None else [label.removeprefix("sub-") for label in labels]
        if unknown := [label for label in wanted if label not in known]:
            shown = f"{', '.join(known[:_SHOWN])}{', …' * (len(known) > _SHOWN)}"
            where = ", ".join(map(str, self.roots))
            raise ValueError(f"--participant-label: got {', '.join(unknown)}; the participants in {where} are {shown}")
        return list(dict.fromkeys(wanted))

    def files(self, participant: str) -> list[File]:
        """Return the files of a participant."""
        if participant not in self._files:
            paths = [(root, path) for root in self.roots for path in sorted((root / f"sub-{participant}").rglob("*"))]
            named = [File(path, parse_name(path.relative_to(root)), root) for root, path in paths if path.is_file()]
            self._files[participant] = [file for file in named if file.name.entities["sub"] == participant]
        return self._files[participant]

    def sources(self, participant: str, wanted: Mapping[str, str]) -> list[Source]:
        """Return the inputs of a participant, one for each combination of the entities that results keep.

        Diffusion-weighted images count only if no tensors have compatible entities.

        Raises:
            FileNotFoundError: there are no inputs.
            ValueError: two inputs have the same entities.
        """
        files = [file for file in self.files(participant) if _has(file.name, wanted)]
        tensors = [(file, kind) for file in files for kind in TENSORS if kind.matches(file.name)]
        images = [(file, kind) for file in files for kind in IMAGES if kind.matches(file.name)]
        of_tensors = [file.name for file, _ in tensors]
        images = [(file, kind) for file, kind in images if not any(_agree(file.name, name) for name in of_tensors)]
        found: dict[str, Source] = {}
        for file, kind in tensors + images:
            tables = [self._table(file, extension) for extension in ("bval", "bvec") if kind in IMAGES]
            if None in tables:
                continue
            if (other := found.get(file.name.source)) is not None:
                raise ValueError(_ambiguous("inputs", [other.file, file], "--select"))
            order = kind.order if kind.order and _by_dtifit(file.path) else None
            found[file.name.source] = Source(file, order, *tables)
        if not found:
            names = "; ".join(kind.names for kind in (*TENSORS, *IMAGES))
            folders = ", ".join(str(root / f"sub-{participant}") for root in self.roots)
            chosen = f" with {format_entities(wanted)}"
            raise FileNotFoundError(
                f"sub-{participant}: no tensors and no diffusion-weighted images{chosen * bool(wanted)} in {folders}. "
                f"Looked for {names}"
            )
        return [found[name] for name in sorted(found)]

    def companion(
        self, source: File, suffix: str, wanted: Mapping[str, str], usual: Mapping[str, str], option: str
    ) -> Path | None:
        """Return the file with the suffix on the voxels of an input, or None.

        The file has the same space, agrees in all common entities, and lies in a folder of the same name, such as
        ``dwi``. Of several files, one in the input's folder, and then one of the same derivative, is preferred. If
        `wanted` is empty, the entities in `usual` must be absent or have these labels.

        Raises:
            ValueError: several files remain, or none has the wanted entities.
        """
        files = [file for file in self.files(source.name.entities["sub"]) if file.path != source.path]
        files = [
            file
            for file in files
            if file.name.extension in _IMAGES
            and re.fullmatch(f"(.*_)?{suffix}", file.name.suffix)
            and file.path.parent.name == source.path.parent.name
            and file.name.label("space") == source.name.label("space")
            and _agree(file.name, source.name)
            and (_has(file.name, wanted) if wanted else _may_have(file.name, usual))
        ]
        if not files:
            if wanted:
                raise FileNotFoundError(
                    f"{option}: got {format_entities(wanted)}, but no file *_{suffix}.nii[.gz] or .mif[.gz] with these "
                    f"entities belongs to {source.path}: same space, and a folder {source.path.parent.name}"
                )
            return None

        def rank(file: File) -> tuple[int, bool, bool]:
            shared = kept(file.name.entities).items() & kept(source.name.entities).items()
            return len(shared), file.path.parent == source.path.parent, file.root == source.root

        best = max(map(rank, files))
        files = [file for file in files if rank(file) == best]
        if len(files) > 1:
            raise ValueError(_ambiguous(f"files *_{suffix}", files[:2], option))
        return files[0].path

    def masks(self, participant: str) -> list[Path]:
        """Return all masks of a participant beside images of diffusion."""
        files = [file for file in self.files(participant) if file.path.parent.name == "dwi"]
        return [f.path for f in files if f.name.extension in _IMAGES and re.fullmatch("(.*_)?mask", f.name.suffix)]

    def inherited(self, file: File) -> dict[str, Any]:
        """Return the metadata of an image, if BIDS's inheritance adds to its sidecar; otherwise an empty dictionary.

        A JSON file of fewer entities, beside the image or in a folder above, describes the image too; a nearer file
        replaces entries of the others.
        """
        chain = [path for folder in self._above(file) for path in reversed(_applying(file, folder, "json"))]
        merged = dict[str, Any]()
        for path in reversed(chain):
            content = read_json(path)
            merged |= content if isinstance(content, dict) else {}
        return merged if any(path != sidecar_of(file.path) for path in chain) else {}

    def covariates(self) -> dict[str, dict[str, str]]:
        """Return the rows of participants.tsv without their first column, by participant (``sub-01``)."""
        tables = [root / "participants.tsv" for root in (self.folder, *self.roots)]
        rows = next((read_table(table) for table in tables if table.is_file()), [])
        return {row.pop("participant_id"): row for row in map(dict, rows) if "participant_id" in row}

    def _table(self, file: File, extension: str) -> Path | None:
        """Return the b-values or directions of images: of the same name, or inherited from a folder above."""
        return next((found[-1] for folder in self._above(file) if (found := _applying(file, folder, extension))), None)

    def _above(self, file: File) -> list[Path]:
        """Return the folders from that of a file up to the root of its derivative."""
        folders = [file.path.parent, *file.path.parent.parents]
        return folders[: folders.index(file.root) + 1]


def _applying(file: File, folder: Path, extension: str) -> list[Path]:
    """Return the files of a folder that describe an image by BIDS's inheritance; the last has the most entities."""
    names = {path: parse_name(path.name) for path in sorted(folder.glob(f"*.{extension}"))}
    fitting = [
        path
        for path, name in names.items()
        if name.suffix == file.name.suffix and name.entities.items() <= file.name.entities.items()
    ]
    return sorted(fitting, key=lambda path: len(names[path].entities))


def _with_derivatives(folder: Path) -> list[Path]:
    """Return a folder and all folders of derivatives within it, also of derivatives of derivatives."""
    return [folder, *(below for one in sorted(folder.glob("derivatives/*/")) for below in _with_derivatives(one))]


def _by_dtifit(path: Path) -> bool:
    """Return whether the first eigenvectors are beside the tensors, as dtifit writes them."""
    return path.with_name(re.sub(r"tensor(?=\.)", "V1", path.name)).is_file()


def _is_raw(folder: Path) -> bool:
    about = read_json(folder / "dataset_description.json")
    derived = about.get("DatasetType") == "derivative" or "GeneratedBy" in about or "PipelineDescription" in about
    return bool(about) and not derived


def _has(name: Name, wanted: Mapping[str, str]) -> bool:
    return all(name.entities.get(entity) == label for entity, label in wanted.items())


def _may_have(name: Name, usual: Mapping[str, str]) -> bool:
    return all(name.entities.get(entity, label) == label for entity, label in usual.items())


def _agree(one: Name, other: Name) -> bool:
    """Return whether no entity that results keep has two labels."""
    both = kept(one.entities).keys() & kept(other.entities).keys()
    return all(one.entities[entity] == other.entities[entity] for entity in both)


def _ambiguous(what: str, files: list[File], option: str) -> str:
    """Return a message about two files that entities of the results do not tell apart, with the remedy."""
    first, second = files
    differing = [e for e in CONTENT if first.name.entities.get(e) != second.name.entities.get(e)]
    words = [f"{e}-{one.name.entities[e]}" for one in files for e in differing if e in one.name.entities]
    if words:
        remedy = f"Choose one by {' or '.join(f'{option} {word}' for word in words)}"
    elif first.root != second.root:
        remedy = f"Choose one by its folder in place of BIDS_DIR: {first.root} or {second.root}"
    else:
        remedy = "Move one of them to another folder"
    return f"got two {what} with the same entities: {first.path} and {second.path}. {remedy}"
