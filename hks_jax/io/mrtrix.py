"""Read tensors and masks in MRtrix's image format, .mif and .mif.gz.

The header has lines ``key: value`` up to ``END``. The key ``file`` gives the offset of the voxels, and ``layout`` gives
their order (https://mrtrix.readthedocs.io/en/latest/getting_started/image_data.html).
"""

import math

import numpy as np
from jaxtyping import Float

from hks_jax.io.tensor_order import FRAMES, matrices
from hks_jax.io.volume import Format, TensorVolume, placed
from hks_jax.storage import content_of, reading

_MAGIC = b"mrtrix image"
_KINDS = {"Int": "i", "UInt": "u", "Float": "f"}


def _load(name: str) -> tuple[np.ndarray, Float[np.ndarray, "4 4"], str]:
    """Return the voxel values (axes as in the header), the affine to scanner coordinates, and the unit of length."""
    with reading(name, "a readable MRtrix image (.mif)") as file:
        content = content_of(file)
        header, offset = _header(content)
        shape = tuple(int(n) for n in header["dim"][0].split(","))
        if min(shape) < 1 or len(shape) < 3:
            raise ValueError(f"dim: got {header['dim'][0]}; expected at least three positive sizes")
        count, dtype = math.prod(shape), header["datatype"][0].strip()
        length = -(-count // 8) if dtype == "Bit" else count * _dtype(dtype).itemsize
        if len(content) != offset + length:
            raise ValueError(f"got {len(content)} bytes; expected {offset + length} for {dtype} of shape {shape}")
        raw = np.frombuffer(content, np.uint8 if dtype == "Bit" else _dtype(dtype), offset=offset)
        flat = np.unpackbits(raw)[:count] if dtype == "Bit" else raw
        values = _in_order(flat, shape, header["layout"][0])
        if "scaling" in header:
            shift, scale = (float(word) for word in header["scaling"][0].split(","))
            values = values * scale + shift
        affine = np.eye(4)
        affine[:3] = [[float(word) for word in row.split(",")] for row in header["transform"]]
        affine[:3, :3] *= [float(word) for word in header["vox"][0].split(",")[:3]]
        if not np.isfinite(affine).all() or np.linalg.det(affine[:3, :3]) == 0:
            raise ValueError("transform, vox: got a singular or infinite affine; expected an invertible affine")
    return values, affine, "mm"


def _read_tensors(name: str, order: str | None, frame: str | None) -> TensorVolume:
    values, affine, _ = _load(name)
    if values.ndim != 4 or values.shape[-1] != 6:
        raise ValueError(
            f"{name}: got an image of shape {values.shape}; expected (nx, ny, nz, 6), the components from dwi2tensor"
        )
    components = np.ascontiguousarray(values, np.float32 if values.dtype.itemsize <= 4 else np.float64)
    found = matrices(name, components, order, "mrtrix")
    return placed(name, found, frame or FRAMES[found.order], affine)


def _header(content: bytes) -> tuple[dict[str, list[str]], int]:
    """Return the values of each key in the header, and the byte offset of the voxels."""
    end = content.find(b"\nEND\n")
    if not content.startswith(_MAGIC) or end < 0:
        raise ValueError(f"the file does not begin with {_MAGIC.decode()!r} and a header that ends with END")
    header: dict[str, list[str]] = {}
    for line in content[:end].decode().splitlines()[1:]:
        key, _, value = line.partition(":")
        header.setdefault(key.strip(), []).append(value.strip())
    where, offset = header["file"][0].split()
    if where != "." or int(offset) < end:
        raise ValueError(f"file: got {header['file'][0]!r}; expected '. OFFSET', for voxels in the same file")
    return header, int(offset)


def _dtype(name: str) -> np.dtype:
    """Return the NumPy dtype of a name such as Float32LE, Int16BE or UInt8."""
    bare, order = (name[:-2], "<" if name.endswith("LE") else ">") if name[-2:] in ("LE", "BE") else (name, "=")
    kind = bare.rstrip("0123456789")
    if kind not in _KINDS:
        raise ValueError(f"datatype: got {name}; expected real numbers")
    return np.dtype(f"{order}{_KINDS[kind]}{int(bare[len(kind) :]) // 8}")


def _in_order(flat: np.ndarray, shape: tuple[int, ...], layout: str) -> np.ndarray:
    """Return the stored values as an array; a layout such as ``-0,+1,+2`` gives the rank and direction of each axis."""
    words = [word.strip() for word in layout.split(",")]
    ranks = [int(word.lstrip("+-")) for word in words]
    if sorted(ranks) != list(range(len(shape))):
        raise ValueError(f"layout: got {layout}; expected a permutation of {len(shape)} axes")
    slowest_first = sorted(range(len(shape)), key=lambda axis: -ranks[axis])
    stored = flat.reshape([shape[axis] for axis in slowest_first])
    values = stored.transpose(np.argsort(slowest_first))
    return values[tuple(slice(None, None, -1 if word.startswith("-") else 1) for word in words)]


FORMAT = Format((".mif", ".mif.gz"), _read_tensors, read_image=_load, image=".nii.gz")
