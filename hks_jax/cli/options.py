"""The options that several commands share, in groups: each function adds a group to a parser."""

import argparse
from collections.abc import Callable
from pathlib import Path
from typing import Any

from hks_jax.cli.parsing import axis_and_index, boundary_conditions, folder, positive_map, repair
from hks_jax.eigen.automatic import SOLVERS
from hks_jax.io import ORDERS, UNITS
from hks_jax.io.formats import SUFFIXES

FORMATS = ", ".join(SUFFIXES)


class FirstAndOthers(argparse.Action):
    """Store the first file as `file` and the other files as `others`."""

    def __call__(self, parser: Any, namespace: argparse.Namespace, values: Any, *_option: Any) -> None:
        """Store the files."""
        namespace.file, namespace.others = values[0], values[1:]


def add_file(parser: argparse.ArgumentParser) -> None:
    """Add the files of tensors."""
    parser.add_argument(
        "file",
        action=FirstAndOthers,
        nargs="+",
        type=Path,
        metavar="FILE",
        help=f"tensors: {FORMATS}; or six images of one component each (…txx… to …tzz…), or one of these images; or "
        "diffusion-weighted images with --bval and --bvec",
    )


def add_output(parser: argparse.ArgumentParser) -> None:
    """Add the folder for the results."""
    parser.add_argument("-o", "--output", type=folder, required=True, metavar="OUT", help="folder for the results")


def add_metric(parser: argparse.ArgumentParser) -> None:
    """Add the metric and the operator."""
    group = parser.add_argument_group("the metric")
    group.add_argument(
        "--metric",
        choices=("tensor", "inverse", "adjugate"),
        help="the metric that is made of the diffusion tensors D. inverse: D⁻¹, in which two points are near if water "
        "diffuses quickly between them, as along a fibre; t is then a time, in s for D in mm2/s and voxels in mm. "
        "This is the usual choice for the geometry of diffusion MRI. tensor: D itself, in which points are near if "
        "diffusion is slow. adjugate: |D|D⁻¹, which is D⁻¹ times the determinant of D. Without --operator fick, the "
        "option is required except for NumPy's files without a unit of length, whose tensors are the metric by default",
    )
    group.add_argument(
        "--operator",
        choices=("laplace-beltrami", "fick"),
        default="laplace-beltrami",
        help="laplace-beltrami: the operator of the metric (default), which does not depend on coordinates; for D⁻¹ "
        "it differs from the diffusion of a substance where the determinant of D varies. fick: the diffusion of a "
        "substance by Fick's law, div(D∇u), whose density becomes uniform in space; it takes no --metric, and t is a "
        "time as for inverse",
    )


def add_reading(parser: argparse.ArgumentParser) -> None:
    """Add the options for reading tensors."""
    group = parser.add_argument_group("voxels")
    group.add_argument(
        "--slice", type=axis_and_index, metavar="AXIS=N", help="one slice, such as z=14, instead of the volume"
    )
    group.add_argument(
        "--mask",
        type=Path,
        metavar="FILE",
        help="zeros and ones in NIfTI, MRtrix, NRRD, .npy, or in the array 'mask' of an .npz",
    )
    group.add_argument(
        "--background",
        choices=("outside", "inside"),
        help="without --mask, whether voxels that a program filled with equal isotropic tensors, or with tensors near "
        "zero, are outside or inside the domain (default: inside, with a warning). Zero tensors are outside, except "
        "with --positive",
    )
    group.add_argument(
        "--erode",
        type=int,
        default=0,
        metavar="N",
        help="remove N layers of voxels from the boundary of the mask (default 0)",
    )
    group = parser.add_argument_group(
        "meaning of the numbers", "needed only if the file does not declare it. Wrong axes mirror the tensors."
    )
    add_conventions(group)
    group.add_argument(
        "--array",
        metavar="NAME",
        help="name of the tensors' array in an npz or VTK file with several arrays, or in the file of a mesh",
    )
    group.add_argument(
        "--spacing",
        nargs="+",
        type=float,
        metavar="H",
        help="distance between nodes, for .npy and .npz files that do not contain it",
    )
    group.add_argument(
        "--confidence",
        type=float,
        default=0.5,
        metavar="C",
        help="confidence above which a voxel of NRRD's masked tensors belongs to the mask (default 0.5)",
    )
    group = parser.add_argument_group("tensors that are not positive definite", "by default, they raise an error")
    group.add_argument(
        "--repair",
        type=repair,
        metavar="HOW[:FLOOR]",
        help="repair of a few tensors: clip raises their eigenvalues to FLOOR (default: 1 %% of the median of mean "
        "eigenvalues), mask leaves their voxels out, nearest uses the nearest valid tensor. With FLOOR, tensors with "
        "an eigenvalue below FLOOR are also repaired",
    )
    group.add_argument(
        "--positive",
        type=positive_map,
        metavar="HOW:NUMBER",
        help="map for tensors T that are naturally indefinite, such as stress: exp:S uses exp(T/S) and shift:C uses T "
        "+ C·I as the metric; combine it with --metric tensor",
    )
    group = parser.add_argument_group(
        "diffusion-weighted images", "a fit gives the tensors. Without --mask, DIPY's median_otsu finds the brain."
    )
    group.add_argument("--bval", type=Path, metavar="FILE", help="b-values, in s/mm2 unless --unit is given")
    group.add_argument(
        "--bvec",
        type=Path,
        metavar="FILE",
        help="gradient directions of length 1 in three rows or three columns, as dcm2niix writes them (see "
        "--bvec-frame)",
    )
    group.add_argument(
        "--bvec-frame",
        choices=("fsl", "voxel", "world"),
        help="axes of the directions: the voxel axes, the first reversed if the affine's determinant is positive "
        "(fsl, the default, for FSL, dcm2niix and BIDS), the voxel axes (voxel), or the scanner's axes (world, for "
        "MRtrix)",
    )
    group.add_argument(
        "--b-max",
        type=float,
        metavar="B",
        help="largest b-value used, in s/mm2 (default: all are used, with a warning above 1500, up to which the "
        "tensor model holds)",
    )


def add_conventions(parser: argparse.ArgumentParser | argparse._ArgumentGroup) -> None:
    """Add the order, the axes and the unit of the components of tensors."""
    parser.add_argument("--order", choices=tuple(ORDERS), help="order of the components")
    parser.add_argument(
        "--frame",
        choices=("voxel", "fsl", "world", "measurement"),
        help="axes of the components: the voxel axes (voxel), the axes of FSL's b-vectors (fsl, for tensors from DIPY "
        "and FSL), the scanner's axes (world, for MRtrix), or NRRD's measurement frame",
    )
    parser.add_argument(
        "--unit",
        choices=tuple(UNITS),
        help="unit of the tensors, which are converted to mm2/s. Water in living tissue has about 7e-4 mm2/s, which "
        "is 0.7 um2/ms, 700 um2/s (TORTOISE) or 7e-10 m2/s. With --bval, the b-values have the reciprocal unit",
    )


def add_components(parser: argparse.ArgumentParser) -> None:
    """Add the choice of the mask's components."""
    parser.add_argument(
        "--components",
        choices=("raise", "largest", "all"),
        default="raise",
        help="if the mask is not connected: raise an error (default), keep the largest component, or keep all "
        "components",
    )


def add_dtype(parser: argparse.ArgumentParser) -> None:
    """Add the precision."""
    parser.add_argument(
        "--dtype", choices=("float32", "float64"), default="float64", help="floating-point precision (default float64)"
    )


def add_interpolation(parser: argparse.ArgumentParser, default: str | None = "linear", or_else: str = "") -> None:
    """Add the interpolation of the metric; `or_else` describes the interpolation if the default is None."""
    parser.add_argument(
        "--interpolation",
        choices=("linear", "log-euclidean"),
        default=default,
        help="interpolation of the metric between nodes: linear, of its components, or log-euclidean, of its "
        f"logarithm, which preserves volumes if tensors rotate (default: {default or or_else})",
    )


def add_solving(parser: argparse.ArgumentParser) -> None:
    """Add the options for computing eigenpairs."""
    add_components(parser)
    add_dtype(parser)
    add_interpolation(parser)
    group = parser.add_argument_group("the eigenpairs")
    group.add_argument(
        "--boundary",
        type=boundary_conditions,
        metavar="CONDITION",
        help="neumann; mean (the average of the Neumann and Dirichlet problems, which reduces the influence of a "
        "mask's boundary); dirichlet; dirichlet-rim (also on the boundary of a mask); periodic; or mirror. Give one "
        "condition for all axes, or one per axis, as in neumann,periodic; a condition for the boundary of a mask may "
        "follow them. low:high gives different conditions at the two sides of an axis, as in "
        "neumann:dirichlet,neumann (default: mean if the domain has a mask, otherwise neumann; neumann for meshes and "
        "spectra; for a study, its previous condition, or mean at first)",
    )
    group.add_argument(
        "-k",
        type=int,
        metavar="K",
        help="number of eigenpairs; for the boundary mean, the number for both problems together (default 200, or 100 "
        "for a volume, or a quarter of the unknowns if that is less)",
    )
    group.add_argument("--solver", choices=("auto", *SOLVERS), default="auto", help="eigensolver (default auto)")


def add_signature(parser: argparse.ArgumentParser) -> None:
    """Add the options of the signature."""
    group = parser.add_argument_group("the signature")
    group.add_argument(
        "--times",
        nargs="+",
        metavar="T",
        help="positive numbers, in s for --metric inverse and --operator fick of tensors in mm2/s; or auto, or auto:N "
        "for N times from the first that the eigenpairs resolve to the time at which half of the nodes are free of "
        "the boundary (influence below 10 %%), at least a factor of 2 apart (default auto:6). 'hks-jax info FILE' "
        "shows suitable times",
    )
    group.add_argument(
        "--normalisation",
        choices=("raw", "heat-trace", "volume", "flat"),
        default="flat",
        help="normalisation of the signature: flat is (4πt)^(d/2)·HKS, which is 1 for flat space (default), raw is "
        "HKS itself, volume is HKS times the volume of the domain, and heat-trace is HKS divided by its integral",
    )
    group.add_argument(
        "--method",
        choices=("spectral", "auto"),
        default="spectral",
        help="method: a sum over eigenpairs (default), or for auto a computation without eigenpairs at times that are "
        "too small for them. For auto, the report lists the times of each method and their agreement",
    )


def add_noise(parser: argparse.ArgumentParser) -> None:
    """Add the options of error bars."""
    group = parser.add_argument_group("error bars")
    group.add_argument(
        "--noise",
        metavar="NOISE",
        help="noise of the tensors, for error bars: a number relative to the mean diffusivity, such as 0.1; "
        "residuals, for the residuals of the fit to diffusion-weighted images; a second FILE of tensors, from another "
        "scan of the subject; or roughness, for differences of neighbouring voxels. The option adds deviation, bias "
        "and z to the .npz, the signal-to-noise ratio at each t to the report, the column error to tables of regions, "
        "and fades parts of the picture that noise may explain. Automatic times of a single subject begin at a "
        "sufficient signal-to-noise ratio",
    )
    group.add_argument(
        "--draws",
        type=int,
        default=8,
        metavar="N",
        help="number of noisy maps from which error bars are computed (default 8)",
    )


def add_atlas(parser: argparse.ArgumentParser) -> None:
    """Add the label map."""
    parser.add_argument(
        "--atlas",
        type=Path,
        metavar="FILE",
        help="integer labels on the image's voxels, with 0 for unlabelled (NIfTI, MRtrix, NRRD or .npy)",
    )


def add_names(parser: argparse.ArgumentParser) -> None:
    """Add the names of labels."""
    parser.add_argument(
        "--names",
        type=Path,
        metavar="FILE",
        help="names of the labels: a table with the columns index and name, or lines of a number and a name, such as "
        "FreeSurfer's (default: the .tsv of the same name beside the labels, if it exists)",
    )


def add_clean(parser: argparse.ArgumentParser) -> None:
    """Add the cleaning of meshes."""
    parser.add_argument(
        "--clean",
        action="store_true",
        help="clean a mesh: merge coincident vertices, remove NaN vertices, duplicate cells, cells of zero area and "
        "unused vertices, and list the changes",
    )


def add_vertices(parser: argparse.ArgumentParser) -> None:
    """Add the cleaning and the domain of meshes."""
    add_clean(parser)
    parser.add_argument(
        "--inside",
        type=Path,
        metavar="FILE",
        help="vertices of a mesh that form the domain, such as a cortical surface without its medial wall: "
        "FreeSurfer's .label, or zeros and ones in .npy or in the array 'mask' of an .npz, in the numbering of the "
        "file, before --clean. Cells outside may be degenerate or NaN",
    )


def add_meshes(parser: argparse.ArgumentParser) -> None:
    """Add the options of meshes: cleaning, domain, and tensors in a volume."""
    add_vertices(parser)
    parser.add_argument(
        "--tensors",
        type=Path,
        metavar="FILE",
        help="tensors of a volume that contains the mesh (a cortical surface, for example). The tensors are "
        "interpolated at the vertices in scanner coordinates (FreeSurfer's surfaces are moved by c_ras, GIFTI's by "
        "their transformation). The options on voxels and on the meaning of numbers refer to this file",
    )


def add_view(parser: argparse.ArgumentParser) -> None:
    """Add the orientation of pictures."""
    parser.add_argument(
        "--view",
        choices=("neurological", "radiological"),
        default="neurological",
        help="orientation of pictures of a volume with an affine: neurological, left on the left (default), or "
        "radiological, left on the right. Front and head are at the top or on the right, for any storage order of the "
        "voxels",
    )


def add_rim(parser: argparse.ArgumentParser) -> None:
    """Add the drawing of the boundary's influence."""
    parser.add_argument(
        "--show-rim",
        action="store_true",
        help="draw the nodes near the boundary like all others. Pictures hatch the nodes at which the boundary "
        "contributes over 10 %% of the signature, where the shape of the domain shows and not curvature; curves over "
        "t are pale there",
    )


def add_common(parser: argparse.ArgumentParser) -> None:
    """Add the options of all commands."""
    parser.add_argument("--json", action="store_true", help="print a summary as JSON instead of the names of the files")
    parser.add_argument("-q", "--quiet", action="store_true", help="show no progress")
    parser.add_argument(
        "--no-cache", action="store_true", help="neither use nor store compiled programs in the user's cache folder"
    )
    parser.add_argument("--debug", action="store_true", help="show the traceback of an error")


FILES = ("mask", "bval", "bvec", "atlas", "names")
"""Options whose values are files of a subject."""


def defaults(*groups: Callable[[argparse.ArgumentParser], None]) -> dict[str, Any]:
    """Return the default values of the options in groups, by name."""
    parser = argparse.ArgumentParser(add_help=False)
    for add in groups:
        add(parser)
    return vars(parser.parse_args([]))


COLUMNS = [name.replace("_", "-") for name in defaults(add_reading, add_noise) if name not in FILES]
"""The columns of a table of subjects that have the meaning of the option with the same name."""

_ARGUMENTS = {name: name for name in defaults(add_metric, add_reading, add_solving, add_signature, add_noise)}
_ARGUMENTS |= {name: name for name in ("smoothness", "max_steps", "continuation", "starts", "parametrisation")}
_ARGUMENTS |= {"iterations": "erode", "level": "noise", "f": "map", "fwhm": "fwhm", "clean": "clean"}
"""The option that gives an argument of the library, by the argument's name in messages."""


def flag(name: str) -> str:
    """Return the flag of an option."""
    return ("-" if len(name) == 1 else "--") + name.replace("_", "-")


def of_arguments(args: argparse.Namespace) -> dict[str, str]:
    """Return the flags of the options of a command that give arguments of the library, by the arguments' names."""
    return {name: flag(option) for name, option in _ARGUMENTS.items() if option in args}
