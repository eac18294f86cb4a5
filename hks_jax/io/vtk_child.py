"""Reads a file of VTK's, as a script in a process of its own: ``vtk_child.py FILE ARRAYS.npz BYTES``.

VTK follows damaged files into memory that is not its own, and ends the process where it cannot allocate the memory
that they declare. The script imports nothing of this package, which would take longer than the reading.
"""

import contextlib
import re
import sys
from typing import Any

import numpy as np


def image(data: Any) -> dict[str, Any]:
    """Return where image data lie."""
    matrix = data.GetDirectionMatrix()
    direction = [[matrix.GetElement(i, j) for j in range(3)] for i in range(3)]
    place = {"extent": data.GetExtent(), "spacing": data.GetSpacing(), "origin": data.GetOrigin()}
    return {**place, "direction": direction}


def surface(data: Any) -> dict[str, Any]:
    """Return the points of polygonal data, and their polygons and strips cut into triangles."""
    from vtkmodules.util.numpy_support import vtk_to_numpy
    from vtkmodules.vtkFiltersCore import vtkTriangleFilter

    for cells in (data.GetPolys(), data.GetStrips()):
        corners, ends = (
            np.asarray(vtk_to_numpy(array), np.int64)
            for array in (cells.GetConnectivityArray(), cells.GetOffsetsArray())
        )
        # The filter reads at any index without checking it.
        if corners.size and not 0 <= corners.min() <= corners.max() < data.GetNumberOfPoints():
            raise ValueError(f"a polygon has the corner {corners.max()} of {data.GetNumberOfPoints()} points")
        if ends.size and (ends[0] != 0 or ends[-1] != corners.size or (np.diff(ends) < 3).any()):
            raise ValueError("the polygons' offsets do not ascend from none to all corners, three or more each")
    cut = vtkTriangleFilter()
    cut.PassLinesOff()
    cut.PassVertsOff()
    cut.SetInputData(data)
    cut.Update()
    if not cut.GetOutput().GetNumberOfPolys():
        raise ValueError("it has no triangles")
    faces = vtk_to_numpy(cut.GetOutput().GetPolys().GetConnectivityArray()).reshape(-1, 3)
    return {"points": vtk_to_numpy(cut.GetOutput().GetPoints().GetData()), "faces": faces}


def main(path: str, output: str, room: str) -> None:
    """Write the content of a file as an npz, using at most `room` bytes of memory."""
    from vtkmodules.util.numpy_support import vtk_to_numpy
    from vtkmodules.vtkCommonCore import vtkOutputWindow, vtkStringOutputWindow
    from vtkmodules.vtkIOLegacy import vtkGenericDataObjectReader
    from vtkmodules.vtkIOXML import vtkXMLGenericDataObjectReader

    with contextlib.suppress(ImportError):  # Windows has no limits
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
        raise ValueError(said[0] if said else "VTK finds nothing in it")
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
