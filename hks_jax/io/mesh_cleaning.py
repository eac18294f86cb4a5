"""What is wrong with meshes as programs leave them, and putting it right if asked."""

import numpy as np
from jaxtyping import Float, Int
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree

from hks_jax.domain.simplices import WORDS, signed_measure
from hks_jax.domain.triangulation import Triangulation
from hks_jax.io.mesh_formats import Loaded

_NEAR = 1e-8
"""Distance, relative to the size of the mesh, up to which vertices lie at the same place."""
_THIN = 1e-7
"""Height of a triangle, relative to its longest edge, up to which the edge is flipped."""


def same_places(vertices: Float[np.ndarray, "V 3"]) -> Int[np.ndarray, " V"]:
    """Return for each vertex the first one at its place; one that is not finite is at a place of its own."""
    finite = np.flatnonzero(np.isfinite(vertices).all(axis=1))
    first = np.arange(len(vertices))
    if not finite.size:
        return first
    points = vertices[finite]
    # Copies first: in a soup of triangles there are many at each place, and pairs of them more yet.
    _, copy, place = np.unique(points + 0.0, axis=0, return_index=True, return_inverse=True)
    size = float(np.linalg.norm(np.ptp(points, axis=0)))
    pairs = cKDTree(points[copy]).query_pairs(_NEAR * size, output_type="ndarray")
    graph = coo_matrix((np.ones(len(pairs)), pairs.T), shape=(len(copy),) * 2)
    labels = connected_components(graph, directed=False)[1][place.ravel()]
    _, least = np.unique(labels, return_index=True)
    first[finite] = finite[least[labels]]
    return first


def require_joined(loaded: Loaded) -> str:
    """Return a warning if vertices lie at the same place, as at seams; the empty text if none do.

    Raises:
        ValueError: the mesh falls into more pieces than it would if they were one.
    """
    first = same_places(loaded.vertices)
    doubled = int((first != np.arange(len(first))).sum())
    if not doubled:
        return ""
    pieces, joined = (
        len(np.unique(Triangulation(cells, len(first)).labels[0][cells]))
        for cells in (loaded.cells, first[loaded.cells])
    )
    what = f"{doubled} of {len(first)} vertices lie where another one lies"
    if joined < pieces:
        raise ValueError(
            f"vertices: {what}, and so the mesh falls into {pieces} pieces that touch; there would be {joined} if they "
            "were one vertex each"
        )
    return f"{what}: the mesh is torn there, as at the seams of a texture, and no heat goes across"


def cleaned(loaded: Loaded) -> tuple[Loaded, str]:
    """Return the mesh as `read_mesh` documents it, and what was done, in words; the empty text if that is nothing."""
    words = WORDS[loaded.cells.shape[1] - 1]
    first, n_cells, done = same_places(loaded.vertices), len(loaded.cells), []

    def say(count: int, what: str) -> None:
        if count:
            done.append(f"{count} {what}")

    finite = np.isfinite(loaded.vertices).all(axis=1)
    say(int((~finite).sum()), "vertices that are NaN or infinite removed")
    cells = first[loaded.cells[finite[loaded.cells].all(axis=1)]]
    say(n_cells - len(cells), f"{words.simplices} at them removed")
    say(int((first != np.arange(len(first))).sum()), "vertices merged with another one at the same place")
    flat = (np.diff(np.sort(cells, axis=1), axis=1) == 0).any(axis=1)
    if cells.shape[1] == 3:
        cells, flipped = _without_thin(loaded.vertices, cells[~flat])
        say(flipped, "edges flipped that passed through a vertex")
    else:
        inverted = signed_measure(loaded.vertices, cells)[0] < 0
        say(int(inverted.sum()), f"{words.simplices} turned round")
        cells = np.where(inverted[:, None], cells[:, [1, 0, 2, 3]], cells)[~flat]
    sound = signed_measure(loaded.vertices, cells)[1]
    say(int(flat.sum() + (~sound).sum()), f"{words.simplices} without {words.measure} removed")
    _, once = np.unique(np.sort(cells[sound], axis=1), axis=0, return_index=True)
    say(int(sound.sum()) - len(once), f"{words.simplices} removed that are there twice")
    cells = cells[sound][np.sort(once)]
    used, numbered = np.unique(cells, return_inverse=True)
    say(int((finite & (first == np.arange(len(first)))).sum()) - len(used), f"vertices without a {words.one} removed")
    arrays = {name: values[used] for name, values in loaded.arrays.items()}
    return Loaded(loaded.vertices[used], numbered.reshape(cells.shape), arrays), "; ".join(done)


def _without_thin(
    vertices: Float[np.ndarray, "V 3"], cells: Int[np.ndarray, "n 3"]
) -> tuple[Int[np.ndarray, "m 3"], int]:
    """Flip the longest edges of triangles that have hardly a height: the surface stays, and has no crack.

    Returns the triangles, without those that lie on a boundary, and how many edges were flipped.
    """
    cells, gone, flipped = cells.copy(), np.zeros(len(cells), bool), 0
    corners = vertices[cells]
    lengths = np.linalg.norm(np.roll(corners, -1, axis=1) - corners, axis=2)
    thin = signed_measure(vertices, cells)[0] <= _THIN * lengths.max(axis=1) ** 2
    for cell in np.flatnonzero(thin):
        corners = vertices[cells[cell]]
        longest = int(np.argmax(np.linalg.norm(np.roll(corners, -1, axis=0) - corners, axis=1)))
        a, b, c = np.roll(cells[cell], -longest)
        beside = np.flatnonzero((cells == a).any(axis=1) & (cells == b).any(axis=1) & ~gone)
        beside = beside[beside != cell]
        if len(beside) == 1:
            other = cells[beside[0]]
            (d,) = other[(other != a) & (other != b)]
            cells[cell], cells[beside[0]] = (a, d, c), (d, b, c)
            flipped += 1
        elif not len(beside):
            gone[cell] = True
    return cells[~gone], flipped
