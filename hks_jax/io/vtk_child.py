"""Read a VTK file in a separate process, as the script ``vtk_child.py FILE ARRAYS.npz BYTES``.

VTK is not called in the user's process, because about 1 of 50 randomly damaged files ends the process that reads them:
VTK follows wrong indices out of memory, and aborts if it cannot allocate a declared size. PyVista reads by VTK, and for
many damaged files returns data without the damaged arrays. This script does not import the package, because that would
take longer than the reading.
"""

import contextlib
import re
import sys
from typing import Any

import numpy as np


def image(data: Any) -> dict[str, Any]:
    """Return the extent, spacing, origin and directions of image data."""
    matrix = data.GetDirectionMatrix()
    direction = [[matrix.GetElement(i, j) for j in range(3)] for i in range(3)]
    place = {"extent": data.GetExtent(), "spacing": data.GetSpacing(), "origin": data.GetOrigin()}
    return {**place, "direction": direction}


def surface(data: Any) -> dict[str, Any]:
    """Return the points of polygonal data, and the triangles of their polygons and strips with their cells."""
    from vtkmodules.util.numpy_support import numpy_to_vtk, vtk_to_numpy
    from vtkmodules.vtkFiltersCore import vtkTriangleFilter

    for cells in (data.GetPolys(), data.GetStrips()):
        corners, ends = (
            np.asarray(vtk_to_numpy(array), np.int64)
            for array in (cells.GetConnectivityArray(), cells.GetOffsetsArray())
        )
        # vtkTriangleFilter does not check indices.
        if corners.size and not 0 <= corners.min() <= corners.max() < data.GetNumberOfPoints():
            raise ValueError(f"a polygon refers to point {corners.max()}; expected 0 … {data.GetNumberOfPoints() - 1}")
        if ends.size and (ends[0] != 0 or ends[-1] != corners.size or (np.diff(ends) < 3).any()):
            raise ValueError("expected offsets of polygons from 0 to the number of corners, in steps of 3 or more")
    cut = vtkTriangleFilter()
    cut.PassLinesOff()
    cut.PassVertsOff()
    numbered = data.NewInstance()
    numbered.ShallowCopy(data)
    numbered.GetCellData().Initialize()
    numbered.GetCellData().SetScalars(numpy_to_vtk(np.arange(data.GetNumberOfCells()), deep=True))
    cut.SetInputData(numbered)
    cut.Update()
    if not cut.GetOutput().GetNumberOfPolys():
        raise ValueError("the file has no triangles")
    faces = vtk_to_numpy(cut.GetOutput().GetPolys().GetConnectivityArray()).reshape(-1, 3)
    points, cells = cut.GetOutput().GetPoints().GetData(), cut.GetOutput().GetCellData().GetScalars()
    return {"points": vtk_to_numpy(points), "faces": faces, "cells_of_faces": vtk_to_numpy(cells)}


def main(path: str, output: str, room: str) -> None:
    """Write the content of a file to an npz, using at most `room` bytes of memory."""
    from vtkmodules.util.numpy_support import vtk_to_numpy
    from vtkmodules.vtkCommonCore import vtkOutputWindow, vtkStringOutputWindow
    from vtkmodules.vtkIOLegacy import vtkGenericDataObjectReader
    from vtkmodules.vtkIOXML import vtkXMLGenericDataObjectReader

    with contextlib.suppress(ImportError):  # Windows has no such limits
        import resource

        resource.setrlimit(resource.RLIMIT_AS, (int(room), int(room)))
    messages = vtkStringOutputWindow()
    vtkOutputWindow.SetInstance(messages)
    reader: Any = vtkGenericDataObjectReader() if path.lower().endswith(".vtk") else vtkXMLGenericDataObjectReader()
    reader.SetFileName(path)
    reader.Update()
    data = reader.GetOutput()
    if messages.GetOutput().strip() or data is None:
        said = re.findall(r"\(0x[0-9a-f]+\): (.*)", messages.GetOutput())
        raise ValueError(said[0] if said else "VTK finds no data in the file")
    content = image(data) if data.IsA("vtkImageData") else surface(data) if data.IsA("vtkPolyData") else {}
    for place, attributes in (("point", data.GetPointData()), ("cell", data.GetCellData())):
        for array in map(attributes.GetArray, range(attributes.GetNumberOfArrays())):
            if array is not None:
                content[f"{place}:{array.GetName()}"] = vtk_to_numpy(array)
        if attributes.GetTensors() is not None:
            content[f"{place}s declared"] = attributes.GetTensors().GetName()
    with open(output, "wb") as stream:
        np.savez(stream, kind=data.GetClassName(), **content)


if __name__ == "__main__":
    try:
        main(*sys.argv[1:])
    except Exception as error:
        sys.exit(" ".join(str(error).split()) or type(error).__name__)
