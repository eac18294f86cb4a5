"""Stiffness and mass on meshes of triangles or tetrahedra, linear or quadratic, straight or curved."""

from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from hks_jax.checks import real_array
from hks_jax.compilation import jit_quickly
from hks_jax.domain import spd
from hks_jax.domain.simplicial_mesh import SimplicialMesh
from hks_jax.fem.elements import element_matrices, simplex_element
from hks_jax.fem.fields import Field
from hks_jax.fem.forms import WeakForm
from hks_jax.fem.pencil import Pencil, assembled, gathered, row_sums_of
from hks_jax.fem.resolution import SampledMetric
from hks_jax.fem.space import MeshSpace, vector_space


def mesh_nodes(mesh: SimplicialMesh, degree: int, midpoints: Any) -> Float[Array, "nodes 3"]:
    """Return the positions of the nodes: the vertices and, for degree 2, the midpoints of the edges."""
    if degree not in (1, 2):
        raise ValueError(f"degree: got {degree!r}; expected 1 or 2")
    vertices = mesh.vertices
    if degree == 1:
        if midpoints is not None:
            raise ValueError("midpoints: got positions with degree=1, whose edges are straight; pass degree=2")
        return vertices
    middles = jnp.mean(vertices[mesh.triangulation.edges], axis=1)
    if midpoints is None:
        return jnp.concatenate([vertices, middles])
    if mesh._metric is not None:
        raise ValueError("midpoints: got positions for a mesh with a given metric; leave out midpoints or metric")
    moved = midpoints
    if callable(midpoints):
        on_surface = mesh.triangulation.boundary_edges | (mesh.triangulation.dimension == 2)
        moved = middles.at[on_surface].set(jax.vmap(midpoints)(middles[on_surface]))
    moved = real_array("midpoints", moved)
    if moved.shape != middles.shape:
        raise ValueError(
            f"midpoints: got shape {moved.shape}; expected {middles.shape}, a position for each of "
            "mesh.triangulation.edges, or a function of one position"
        )
    return jnp.concatenate([vertices, moved.astype(vertices.dtype)])


def mesh_points(nodes: Float[Array, "nodes 3"], space: MeshSpace) -> Float[Array, "n q 3"]:
    """Return the positions of the quadrature points in each cell."""
    values = jnp.asarray(simplex_element(space.dimension, space.degree).values, nodes.dtype)
    return jnp.einsum("qi,nix->nqx", values, nodes[space.cells], precision="highest")


@jit_quickly(static_argnames=("space", "operator", "curved"))
def assemble_mesh(
    mesh: SimplicialMesh,
    nodes: Float[Array, "nodes 3"],
    fields: dict[str, Field],
    space: MeshSpace,
    operator: WeakForm,
    curved: bool,
) -> Pencil:
    """Return the pencil of a mesh; if it is ``curved``, its edges pass through their midpoints."""
    element = simplex_element(space.dimension, space.degree)
    shape = len(space.cells), element.weights.size
    if curved:
        slopes = jnp.asarray(element.gradients, nodes.dtype)
        frames = mesh._oriented(jnp.einsum("qia,nix->nqxa", slopes, nodes[space.cells], precision="highest"))
        metric = spd.positive_or_nan(jnp.einsum("nqxa,nqxb->nqab", frames, frames, precision="highest"))
    else:
        metric, frames = (jnp.broadcast_to(x[:, None], (*shape, *x.shape[1:])) for x in (mesh.metric, mesh._edges))
    held = {
        name: field.at_points(lambda x: x[space.cells], element.values, shape[:1]) for name, field in fields.items()
    }
    x, seen = (mesh_points(nodes, space), frames) if operator.own else (None, None)

    def integrals(metric: Array, x: Array | None, frames: Array | None, fields: dict[str, Array]) -> tuple[Array, ...]:
        return element_matrices(metric, element, operator, x, fields, frames)

    stiffness, mass = jax.vmap(integrals)(metric, x, seen, held)
    own = space if operator.components == 1 else vector_space(space, operator.components)
    lumped = volumes = row_sums_of(own, mass)
    if "density" in fields:
        volumes = jnp.sqrt(spd.determinant(metric)) @ element.weights.astype(metric.dtype)
    # The error of P1 elements is estimated from the lengths of edges. No such estimate is known for P2.
    sampled = SampledMetric(jax.lax.stop_gradient(mesh.metric), None) if space.degree == 1 else None
    return assembled(
        gathered(own, stiffness), gathered(own, mass), lumped, sampled, jnp.sum(volumes), own, operator, fields
    )
