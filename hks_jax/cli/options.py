"""The table of all options, which defines the parsers, the settings, the columns of studies and the reference page.

A line of the table defines an option by its flags, its value, its default and, after two spaces, its help text, which
indented lines continue. ``N...`` means one or more values, ``N!`` a required value, and ``a|b`` a choice. An option
without a value is a switch. A line ``[name] title: text`` begins a section, and ``@name`` includes a section in the
options of a command (`OPTIONS` in its module).
"""

import argparse
import re
from collections.abc import Iterable
from pathlib import Path
from types import ModuleType
from typing import Any, NamedTuple

from hks_jax.cli.parsing import KINDS
from hks_jax.io.formats import SUFFIXES, WRITTEN
from hks_jax.io.mesh import READ as MESHES

FORMATS = ", ".join(SUFFIXES)

_SHARED = f"""\
[file]
file FILE...
    tensors: {FORMATS}; or six images of one component each (…txx… to …tzz…), or one of these images; or
    diffusion-weighted images with --bval and --bvec
[output]
-o,--output OUT!  folder for the results
[metric] the metric
--metric tensor|inverse|adjugate
    the metric that is made of the diffusion tensors D. inverse: D⁻¹, in which two points are near if water diffuses
    quickly between them, as along a fibre; t is then a time, in s for D in mm2/s and voxels in mm. This is the usual
    choice for the geometry of diffusion MRI. tensor: D itself, in which points are near if diffusion is slow. adjugate:
    |D|D⁻¹, which is D⁻¹ times the determinant of D. Without --operator fick, the option is required except for NumPy's
    files without a unit of length, whose tensors are the metric by default
--operator laplace-beltrami|fick = laplace-beltrami
    laplace-beltrami: the operator of the metric (default), which does not depend on coordinates; for D⁻¹ it differs
    from the diffusion of a substance where the determinant of D varies. fick: the diffusion of a substance by Fick's
    law, div(D∇u), whose density becomes uniform in space; it takes no --metric, and t is a time as for inverse
[voxels] voxels
--slice AXIS=N  one slice, such as z=14, instead of the volume
--mask FILE  zeros and ones in NIfTI, MRtrix, NRRD, .npy, or in the array 'mask' of an .npz
--background outside|inside
    without --mask, whether voxels that a program filled with equal isotropic tensors, or with tensors near zero, are
    outside or inside the domain (default: inside, with a warning). Zero tensors are outside, except with --positive
--erode N = 0  remove N layers of voxels from the boundary of the mask
[numbers] meaning of the numbers: needed only if the file does not declare it. Wrong axes mirror the tensors.
--order ORDER  order of the components
--frame voxel|fsl|world|measurement
    axes of the components: the voxel axes (voxel), the axes of FSL's b-vectors (fsl, for tensors from DIPY and FSL),
    the scanner's axes (world, for MRtrix), or NRRD's measurement frame
--unit UNIT
    unit of the tensors, which are converted to mm2/s. Water in living tissue has about 7e-4 mm2/s, which is 0.7 um2/ms,
    700 um2/s (TORTOISE) or 7e-10 m2/s. With --bval, the b-values have the reciprocal unit
--array NAME  name of the tensors' array in an npz or VTK file with several arrays, or in the file of a mesh
--spacing H...  distance between nodes, for .npy and .npz files that do not contain it
--confidence C = 0.5  confidence above which a voxel of NRRD's masked tensors belongs to the mask
[invalid] tensors that are not positive definite: by default, they raise an error
--repair HOW[:FLOOR]
    repair of a few tensors: clip raises their eigenvalues to FLOOR (default: 1 % of the median of mean eigenvalues),
    mask leaves their voxels out, nearest uses the nearest valid tensor. With FLOOR, tensors with an eigenvalue below
    FLOOR are also repaired
--positive HOW:NUMBER
    map for tensors T that are naturally indefinite, such as stress: exp:S uses exp(T/S) and shift:C uses T + C·I as the
    metric; combine it with --metric tensor
[dwi] diffusion-weighted images: a fit gives the tensors. Without --mask, DIPY's median_otsu finds the brain.
--bval FILE  b-values, in s/mm2 unless --unit is given
--bvec FILE
    gradient directions of length 1 in three rows or three columns, as dcm2niix writes them (see --bvec-frame)
--bvec-frame fsl|voxel|world
    axes of the directions: the voxel axes, the first reversed if the affine's determinant is positive (fsl, the
    default, for FSL, dcm2niix and BIDS), the voxel axes (voxel), or the scanner's axes (world, for MRtrix)
--b-max B
    largest b-value used, in s/mm2 (default: all are used, with a warning above 1500, up to which the tensor model
    holds)
[domain]
--components raise|largest|all = raise
    if the mask is not connected: raise an error (default), keep the largest component, or keep all components
[dtype]
--dtype float32|float64 = float64  floating-point precision
[interpolation]
--interpolation linear|log-euclidean = linear
    interpolation of the metric between nodes: of its components (default), or of its logarithm, which preserves volumes
    if tensors rotate
[pairs] the eigenpairs
--boundary CONDITION
    neumann; mean (the average of the Neumann and Dirichlet problems, which reduces the influence of a mask's boundary);
    dirichlet; dirichlet-rim (also on the boundary of a mask); periodic; or mirror. Give one condition for all axes, or
    one per axis, as in neumann,periodic; a condition for the boundary of a mask may follow them. low:high gives
    different conditions at the two sides of an axis, as in neumann:dirichlet,neumann (default: mean if the domain has a
    mask, otherwise neumann; neumann for meshes and spectra; for a study, its previous condition, or mean at first)
-k K
    number of eigenpairs; for the boundary mean, the number for both problems together (default 200, or 100 for a
    volume, or a quarter of the unknowns if that is less)
--solver SOLVER = auto  eigensolver
[signature] the signature
--times T...
    positive numbers, in s for --metric inverse and --operator fick of tensors in mm2/s; or auto, or auto:N for N times
    from the first that the eigenpairs resolve to the time at which half of the nodes are free of the boundary
    (influence below 10 %), at least a factor of 2 apart (default auto:6). 'hks-jax info FILE' shows suitable times
--normalisation raw|heat-trace|volume|flat = flat
    normalisation of the signature: flat is (4πt)^(d/2)·HKS, which is 1 for flat space (default), raw is HKS itself,
    volume is HKS times the volume of the domain, and heat-trace is HKS divided by its integral
--method spectral|auto = spectral
    method: a sum over eigenpairs (default), or for auto a computation without eigenpairs at times that are too small
    for them. For auto, the report lists the times of each method and their agreement
[noise] error bars
--noise NOISE
    noise of the tensors, for error bars: a number relative to the mean diffusivity, such as 0.1; residuals, for the
    residuals of the fit to diffusion-weighted images; a second FILE of tensors, from another scan of the subject; or
    roughness, for differences of neighbouring voxels. The option adds deviation, bias and z to the .npz, the
    signal-to-noise ratio at each t to the report, the column error to tables of regions, and fades parts of the picture
    that noise may explain. Automatic times of a single subject begin at a sufficient signal-to-noise ratio
--draws N = 8  number of noisy maps from which error bars are computed
[atlas]
--atlas FILE  integer labels on the image's voxels, with 0 for unlabelled (NIfTI, MRtrix, NRRD or .npy)
[names]
--names FILE
    names of the labels: a table with the columns index and name, or lines of a number and a name, such as FreeSurfer's
    (default: the .tsv of the same name beside the labels, if it exists)
[clean]
--clean
    clean a mesh: merge coincident vertices, remove NaN vertices, duplicate cells, cells of zero area and unused
    vertices, and list the changes
[view]
--view neurological|radiological = neurological
    orientation of pictures of a volume with an affine: neurological, left on the left (default), or radiological, left
    on the right. Front and head are at the top or on the right, for any storage order of the voxels
[rim]
--show-rim
    draw the nodes near the boundary like all others. Pictures hatch the nodes at which the boundary contributes over
    10 % of the signature, where the shape of the domain shows and not curvature; curves over t are pale there
[common]
--json  print a summary as JSON instead of the names of the files
-q,--quiet  show no progress
--no-cache  neither use nor store compiled programs in the user's cache folder
--debug  show the traceback of an error
"""


class _FirstAndOthers(argparse.Action):
    """Store the first file as `file` and the other files as `others`."""

    def __call__(self, parser: Any, namespace: argparse.Namespace, values: Any, *_option: Any) -> None:
        namespace.file, namespace.others = values[0], values[1:]


class Option(NamedTuple):
    """The flags of an option and its arguments for argparse."""

    flags: tuple[str, ...]
    settings: dict[str, Any]

    @classmethod
    def of(cls, line: str) -> "Option":
        """Parse a line of the table."""
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
        if flags == "output":  # for convert, OUT is a file
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
    """A group of options; the help text shows a group with a title separately."""

    name: str
    title: str
    about: str
    options: list[Option]


def _sections(text: str) -> list[Section]:
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
"""The sections for reading tensors."""
SOLVING = "@domain @dtype @interpolation @pairs"
"""The sections for computing eigenpairs."""


def options_in(text: str) -> list[Option]:
    """Return all options in a text, including those of its sections."""
    return [option for section in _sections(text) for option in section.options]


SPELLED = [option.name for option in options_in(f"{READING} @metric {SOLVING} @signature")]
"""The names of options that correspond to arguments of the library."""


def add_options(parser: argparse.ArgumentParser, text: str) -> None:
    """Add the options in a text, including those of its sections."""
    for section in _sections(text):
        group = parser.add_argument_group(section.title, section.about or None) if section.title else parser
        for option in section.options:
            group.add_argument(*option.flags, **option.settings)


def defaults(text: str) -> argparse.Namespace:
    """Return the default values of the options in a text."""
    parser = argparse.ArgumentParser(add_help=False)
    add_options(parser, text)
    return parser.parse_args([])


def refuse(args: argparse.Namespace, names: Iterable[str], why: str) -> None:
    """Raise ValueError with the reason `why` if one of the named options is given."""
    usual = vars(defaults(" ".join(f"@{name}" for name in SECTIONS if name not in ("file", "output"))))
    for name in (name for name in names if name in vars(args)):  # a command may lack some of these options
        if getattr(args, name) != usual.get(name) and getattr(args, name) is not False:
            raise ValueError(f"{flag(name)}: {why}")


def flag(name: str) -> str:
    """Return the flag of an option."""
    return ("-" if len(name) == 1 else "--") + name.replace("_", "-")


_REMEDIES = {
    "clean=True repairs some defects: see read_mesh": "--clean repairs some defects",
    "Read surfaces with in_space=True, use a larger mask, or leave these points out": (
        "Pass a larger --mask, or pass --inside with the vertices inside the mask, to leave these points out"
    ),
}
"""Remedies in the library's messages, and their forms with options."""


def as_options(message: str, names: Iterable[str] = SPELLED) -> str:
    """Return a message of the library with the named arguments replaced by options of the command line.

    ``Pass array`` becomes ``Pass --array``, ``pass frame "fsl"`` and ``pass frame="fsl"`` become ``pass --frame fsl``,
    and ``k: got 0`` at the beginning becomes ``-k: got 0``.
    """
    for name in names:
        message = re.sub(rf"^{name}: ", f"{flag(name)}: ", message)
        argument = rf"\b([Pp]ass|[Cc]hoose|or|try) {name}\b(?! [a-z])(?: \({flag(name)}\))?"
        message = re.sub(rf'{argument}(?: |=|: )"([\w/-]+)"', rf"\1 {flag(name)} \2", message)
        message = re.sub(argument, rf"\1 {flag(name)}", message)
    for name, option in (("iterations", "--erode"), ("level", "--noise"), ("f", "--map"), ("fwhm", "--fwhm")):
        message = re.sub(rf"^{name}: ", f"{option}: ", message)
    for words, options in _REMEDIES.items():
        message = message.replace(words, options)
    return message


FILES = [o.name for o in options_in("@voxels @dwi @atlas @names") if o.settings.get("type") is Path]
"""Options whose values are files of a subject."""
COLUMNS = [o.flags[-1][2:] for o in options_in(f"{READING} @noise") if o.name not in FILES]
"""The columns of a table of subjects that have the meaning of the option with the same name."""

_LISTS = {"meshes": MESHES, "written": WRITTEN, "files": FILES, "columns": COLUMNS}


def add_command(subparsers: Any, command: ModuleType) -> argparse.ArgumentParser:
    """Add the parser of a command, whose help text is the docstring of its module."""
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
    # A word that begins with a minus and a digit is a point, such as -20,35, and not an option.
    parser._negative_number_matcher = re.compile(r"-[\d.]")
    add_options(parser, f"{command.OPTIONS}\n@common")
    parser.set_defaults(run=command.run, command=command, prog=parser.prog, **getattr(command, "DEFAULTS", {}))
    return parser
