"""The options of all commands in one table, from which parsers, settings, the columns of studies and pages follow.

A line of the table is an option: its flags, its value, its default, and after two spaces its help, which goes on in
indented lines. ``N...`` is one or more, ``N!`` must be given, ``a|b`` is one of these, and an option without a value
is a switch. A line ``[name] title: text`` begins a section, and ``@name`` stands for a whole section in
the options of a command (`OPTIONS` in its module, whose docstring is the help).
"""

import argparse
import re
from collections.abc import Iterable
from pathlib import Path
from types import ModuleType
from typing import Any, NamedTuple

from hks_jax.cli.values import KINDS
from hks_jax.io.formats import SUFFIXES, WRITTEN
from hks_jax.io.mesh import READ as MESHES

FORMATS = ", ".join(SUFFIXES)

_SHARED = f"""\
[file]
file FILE...
    tensors: {FORMATS}; or the six images of one component each (…txx… to …tzz…), or one of them; or
    diffusion-weighted images with --bval, --bvec
[output]
-o,--output OUT!  folder for the results
[metric] the metric
--metric tensor|inverse|adjugate
    how distances are made of diffusion tensors D. inverse: D⁻¹, in which places are near if water gets quickly from one
    to the other, as along a fibre; t is then the time of diffusion, in s for D in mm2/s and voxels in mm; take it for
    diffusion MRI unless you know better. tensor: D itself taken for a metric, near is where water is slow. adjugate:
    |D|D⁻¹, D⁻¹ with other areas. Must be chosen but for NumPy's files, which hold the metric itself unless you choose
[voxels] which voxels
--slice AXIS=N  only one slice, such as z=14
--mask FILE  zeros and ones: NIfTI, MRtrix, NRRD, .npy, or .npz with 'mask'
--background outside|inside
    without a mask: whether voxels that a program filled with one isotropic tensor, or near zero, are outside the domain
    or inside (default: inside, with a warning; exact zeros are outside)
--erode N = 0  peel N voxels off the mask's rim
[numbers] what the numbers mean: needed only where the file does not say it; a wrong axis mirrors the tensors
--order ORDER  order of the components
--frame voxel|fsl|world|measurement
    axes of the components: the image's own (voxel), those of FSL's b-vectors (fsl: DIPY's and FSL's tensors), the
    scanner's (world: MRtrix's), or NRRD's measurement frame
--unit UNIT
    of the tensors; they are converted to mm2/s. Water in living tissue has about 7e-4 mm2/s, which is 0.7 um2/ms, 700
    um2/s (TORTOISE) or 7e-10 m2/s. With --bval: the reciprocal of the b-values' unit
--array NAME  the array of tensors in an npz or VTK file that has several
--spacing H...  distance between nodes, for .npy and .npz without one
--confidence C = 0.5  NRRD's masked tensors are inside above it
[invalid] tensors that are not positive definite: without one of these they are refused
--repair HOW[:FLOOR]
    a few of them: clip raises their eigenvalues to FLOOR (a hundredth of the median mean eigenvalue), mask leaves them
    out, nearest takes the nearest valid one; those with an eigenvalue below FLOOR, if given, are treated alike
--positive HOW:NUMBER
    tensors that are indefinite by nature, such as stress: a metric is made of every one, exp:S takes exp(T/S), shift:C
    takes T + C·I; go on with --metric tensor
[dwi] diffusion-weighted images: Tensors are fitted by DIPY; without --mask inside what its median_otsu finds.
--bval FILE  b-values, in s/mm2 unless --unit says otherwise
--bvec FILE
    gradient directions of length 1, three rows or three columns, as dcm2niix writes them (see --bvec-frame)
--bvec-frame fsl|voxel|world
    axes of the directions: the image's, the first reversed where the affine's determinant is positive (fsl, the
    default: FSL, dcm2niix, BIDS), the image's as they are (voxel), or the scanner's (world: MRtrix)
--b-max B  leave out images with larger b, in s/mm2; tensors suit b ≲ 1500
[domain]
--components raise|largest|all = raise
    where the mask falls apart: stop (default), keep the largest piece, or keep all
[dtype]
--dtype float32|float64 = float64  precision
[interpolation]
--interpolation linear|log-euclidean = linear
    of the metric between the nodes: its components (default), or those of its logarithm, which keeps the volume where
    tensors turn
[pairs] the eigenpairs
--boundary CONDITION
    neumann; mean, of Neumann and Dirichlet, under which the rim of a mask hardly shows; dirichlet, dirichlet-rim (the
    rim of a mask, too), periodic or mirror; one for all axes, or one per axis as in neumann,periodic, and then one for
    the rim of a mask; low:high for the two sides, as in neumann:dirichlet,neumann (default: mean where the domain has a
    mask, else neumann; of a mesh, and for a spectrum, neumann; of a study the one it began with, else mean)
-k K
    number of eigenpairs, under the mean of both problems together (default 200, for a volume 100, or a quarter of the
    unknowns if that is less)
--solver SOLVER = auto  eigensolver
[signature] the signature
--times T...
    positive numbers, in s for --metric inverse, or auto, or auto:N for N times that suit the eigenvalues (default
    auto:6); 'hks-jax info FILE' says which suit a file
--normalisation raw|heat-trace|volume|flat = raw  of the signature
--method spectral|spectrum-free|auto = spectral
    sum over eigenpairs (default), do without them, or choose by t, k and the spacing: auto reports which times came
    from where and how the two agree
[noise] error bars
--noise NOISE
    of the tensors, for error bars: a number, relative to the mean diffusivity, such as 0.1; residuals, those of the fit
    to diffusion-weighted images; a second FILE of tensors, from another scan of the subject; or roughness, what
    neighbours differ by. Adds deviation and bias to the .npz, signal to noise at each t to the report, the column error
    to tables of regions, and fades in the picture what noise could make; automatic times of one subject begin where
    signal is
--draws N = 16  noisy maps that error bars are made of
[atlas]
--atlas FILE  labels on the voxels of the image, whole numbers, 0 for none: NIfTI, or .npy of the image's shape
[names]
--names FILE
    names of the labels: a table with the columns index and name, or lines of a number and a name, such as FreeSurfer's
    (default: the .tsv of the same name beside the labels, if it is there)
[clean]
--clean
    of a mesh: merge vertices at the same place, and drop whatever is NaN, without area, there twice, or unused; lists
    the changes
[view]
--view neurological|radiological = neurological
    of pictures of a volume that lies in space: neurological, left on the left (default), or radiological, left on the
    right. Front and head are on top or on the right, however the voxels are stored
[common]
--json  print a summary as JSON, not the names of the files
-q,--quiet  show no progress
--no-cache  neither use nor keep compiled programs in the user's cache folder
--debug  show the traceback of an error
"""


class _FirstAndOthers(argparse.Action):
    """Keeps the first of several files apart from the others."""

    def __call__(self, parser: Any, namespace: argparse.Namespace, values: Any, *_option: Any) -> None:
        namespace.file, namespace.others = values[0], values[1:]


class Option(NamedTuple):
    """How an option is written, and what argparse is told of it."""

    flags: tuple[str, ...]
    settings: dict[str, Any]

    @classmethod
    def of(cls, line: str) -> "Option":
        """Read a line of the table."""
        written, _, text = line.partition("  ")
        flags, _, rest = written.partition(" ")
        word, _, default = rest.partition(" = ")
        settings: dict[str, Any] = {"help": " ".join(text.split()).replace("%", "%%")}
        if default:
            settings["default"] = default
            settings["help"] += f" (default {default})" * ("default" not in text)
        if word.endswith("!"):
            settings["required"], word = True, word[:-1]
        if word.endswith("..."):
            settings["nargs"], word = "+", word[:-3]
        kind = word.split("|") if "|" in word else KINDS.get(word, str)
        if flags == "output":  # a file, of convert
            kind = Path
        if not word:
            settings["action"] = "store_true"
        elif callable(kind):
            settings |= {"type": kind, "metavar": word}
        else:
            settings["choices"] = tuple(kind)
        if flags == "file":
            settings["action"] = _FirstAndOthers
        return cls(tuple(flags.split(",")), settings)

    @property
    def name(self) -> str:
        """The argument's name in Python."""
        return self.flags[-1].lstrip("-").replace("-", "_")


class Section(NamedTuple):
    """Options that belong together; with a title, help shows them so."""

    name: str
    title: str
    about: str
    options: list[Option]


def _sections(text: str) -> list[Section]:
    """Read options as the table has them."""
    found = [Section("", "", "", [])]
    for line in re.sub(r"\n {4}", "  ", text).splitlines():
        if line.startswith("@"):
            found += [*(SECTIONS[name[1:]] for name in line.split()), Section("", "", "", [])]
        elif line.startswith("["):
            name, _, title = line[1:].partition("]")
            title, _, about = title.strip().partition(": ")
            found.append(Section(name, title, about, []))
        elif line:
            found[-1].options.append(Option.of(line))
    return found


SECTIONS: dict[str, Section] = {}
SECTIONS |= {section.name: section for section in _sections(_SHARED)}

READING = "@voxels @numbers @invalid @dwi"
"""The sections on reading tensors."""
SOLVING = "@domain @dtype @interpolation @pairs"
"""Those on the eigenpairs."""


def options_in(text: str) -> list[Option]:
    """Return all options of a text."""
    return [option for section in _sections(text) for option in section.options]


SPELLED = [option.name for option in options_in(f"{READING} @metric {SOLVING} @signature")]
"""The options that arguments of the library correspond to."""


def add_options(parser: argparse.ArgumentParser, text: str) -> None:
    """Add the options that a text has, or names the sections of."""
    for section in _sections(text):
        group = parser.add_argument_group(section.title, section.about or None) if section.title else parser
        for option in section.options:
            group.add_argument(*option.flags, **option.settings)


def defaults(text: str) -> argparse.Namespace:
    """Return the defaults of the options of a text."""
    parser = argparse.ArgumentParser(add_help=False)
    add_options(parser, text)
    return parser.parse_args([])


def refuse(args: argparse.Namespace, names: Iterable[str], why: str) -> None:
    """Raise ValueError, which says why, for the first of some options that is given."""
    usual = vars(defaults(" ".join(f"@{name}" for name in SECTIONS if name not in ("file", "output"))))
    for name in names:
        if getattr(args, name) != usual.get(name) and getattr(args, name) is not False:
            raise ValueError(f"{flag(name)}: {why}")


def flag(name: str) -> str:
    """Return how an option is written."""
    return ("-" if len(name) == 1 else "--") + name.replace("_", "-")


def as_options(message: str, names: Iterable[str] = SPELLED) -> str:
    """Return a message in which the named arguments of the library are spelled as the options of a command.

    ``Pass array`` becomes ``Pass --array``, ``pass frame "fsl"`` and ``pass frame="fsl"`` become ``pass --frame fsl``,
    and ``k: got 0`` at the beginning becomes ``-k: got 0``.
    """
    for name in names:
        message = re.sub(rf"^{name}: ", f"{flag(name)}: ", message)
        argument = rf"\b([Pp]ass|[Cc]hoose|or|try) {name}\b(?! [a-z])(?: \({flag(name)}\))?"
        message = re.sub(rf'{argument}(?: |=|: )"([\w/-]+)"', rf"\1 {flag(name)} \2", message)
        message = re.sub(argument, rf"\1 {flag(name)}", message)
    return message.replace("clean=True puts right what it can: see read_mesh", "--clean puts right what it can")


FILES = [o.name for o in options_in("@voxels @dwi @atlas @names") if o.settings.get("type") is Path]
"""Options that are files of a subject."""
COLUMNS = [o.flags[-1][2:] for o in options_in(f"{READING} @noise") if o.name not in FILES]
"""Columns of a table of subjects that stand for the option of the same name: those of reading tensors, and of noise."""

_LISTS = {"meshes": MESHES, "written": WRITTEN, "files": FILES, "columns": COLUMNS}


def add_command(subparsers: Any, command: ModuleType) -> argparse.ArgumentParser:
    """Add the parser of a command; its help is the docstring of its module."""
    lists = {name: ", ".join(words) for name, words in _LISTS.items()}
    summary, _, text = (command.__doc__ or "").format(**lists).partition("\n\n")
    description, *examples = re.split(r"\n(?=examples?:)", text)
    given = options_in(command.OPTIONS)
    usage = [o.settings["metavar"] for o in given if not o.flags[0].startswith("-")]
    usage += [f"{o.flags[0]} {o.settings['metavar']}" for o in given if o.settings.get("required")]
    parser: argparse.ArgumentParser = subparsers.add_parser(
        command.__name__.rpartition(".")[2],
        help=summary[:1].lower() + summary[1:].rstrip("."),
        usage=" ".join(["%(prog)s", *usage, "[options]"]),
        description=description,
        epilog="".join(examples),
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    # What begins with a minus and a digit is a point, such as -20,35, and no option.
    parser._negative_number_matcher = re.compile(r"-[\d.]")
    add_options(parser, f"{command.OPTIONS}\n@common")
    parser.set_defaults(run=command.run, prog=parser.prog)
    return parser
