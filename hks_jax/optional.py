"""Optional libraries, which are imported on first use; if a library is missing, an error says how to install it."""

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
"""For each optional module: the library's purpose, its name, and the extra of hks-jax that installs the library."""


def optional(module: str) -> ModuleType:
    """Import a module of an optional library, such as ``"dipy.reconst.dti"``; an ImportError says how to install it."""
    try:
        return importlib.import_module(module)
    except ImportError as error:
        what, library, extra = _LIBRARIES[module.partition(".")[0]]
        raise ImportError(f'{what} needs {library}, which is not installed: pip install "hks-jax[{extra}]"') from error
