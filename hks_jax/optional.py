"""Optional libraries, which are imported on first use. If one is not installed, the error states the remedy."""

import importlib
from types import ModuleType

_LIBRARIES = {
    "nibabel": ("reading and writing NIfTI, GIFTI and FreeSurfer's files", "nibabel", "dti"),
    "dipy": ("fitting tensors", "DIPY", "dti"),
    "nrrd": ("reading and writing NRRD", "pynrrd", "nrrd"),
    "vtkmodules": ("reading and writing VTK images", "VTK", "vtk"),
    "meshio": ("reading and writing meshes", "meshio", "mesh"),
    "pyvista": ("rendering volumes", "PyVista", "pyvista"),
}
"""The purpose of each optional package, the library's name, and the extra that installs it."""


def optional(module: str) -> ModuleType:
    """Import a module of an optional library, such as ``"dipy.reconst.dti"``; an ImportError states the remedy."""
    try:
        return importlib.import_module(module)
    except ImportError as error:
        what, library, extra = _LIBRARIES[module.partition(".")[0]]
        raise ImportError(f'{what} needs {library}, which is not installed: pip install "hks-jax[{extra}]"') from error
