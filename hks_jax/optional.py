"""Libraries that are optional: imported when something needs them, or an error that says what to install."""

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
"""By the package that is imported: what needs it, its name, and the extra that installs it."""


def optional(module: str) -> ModuleType:
    """Import a module of an optional library, such as ``"nibabel"`` or ``"dipy.reconst.dti"``.

    Raises:
        ImportError: it is not installed; says what to install.
    """
    try:
        return importlib.import_module(module)
    except ImportError as error:
        what, library, extra = _LIBRARIES[module.partition(".")[0]]
        raise ImportError(f'{what} needs {library}, which is not installed: pip install "hks-jax[{extra}]"') from error
