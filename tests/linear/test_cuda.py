"""Every public computation can be lowered for CUDA, also where none is at hand."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from fields import random_spd
from jax import export

import hks_jax as hj

pytestmark = pytest.mark.filterwarnings("ignore::hks_jax.AccuracyWarning")

TIMES = jnp.array([0.1, 1.0])
RNG = np.random.default_rng(0)
PLANE, VOLUME = (jnp.asarray(random_spd(RNG, shape)) for shape in ((14, 13), (9, 10, 9)))
SPHERE, BALL = hj.examples.sphere_mesh(4), hj.examples.ball_mesh(2)


def grid(tensors):
    return hj.TensorField(hj.Grid(tensors.shape[: tensors.shape[-1]]), tensors)


def pairs(tensors, solver="block-lanczos", boundary="neumann"):
    return hj.eigenpairs(grid(tensors), 6, boundary, solver)


def signature(domain, solver, boundary="neumann"):
    return hj.hks(hj.eigenpairs(domain, 6, boundary, solver), TIMES)


def surface(vertices):
    return hj.SurfaceMesh(vertices, SPHERE.faces)


def solid(vertices):
    return hj.TetMesh(vertices, BALL.cells)


def signatures(tensors):
    """All that is read off the same pairs."""
    known = pairs(tensors)
    return (
        hj.wks(known, jnp.array([-1.0, 1.0]), 0.5),
        hj.scale_invariant_hks(known),
        hj.heat_kernel(known, TIMES, [(3, 4)]),
        hj.diffusion_distance(known, TIMES, [(3, 4)]),
        hj.biharmonic_distance(known, [(3, 4)]),
        hj.heat_trace(known, TIMES),
        hj.heat_flow(known, TIMES, jnp.ones(tensors.shape[:2])),
    )


COLOURING = hj.colouring(grid(PLANE), TIMES)

COMPUTATIONS = {
    "dense": (lambda T: signature(grid(T), "dense"), PLANE),
    "block Lanczos": (lambda T: signature(grid(T), "block-lanczos"), PLANE),
    "filter": (lambda T: signature(grid(T), hj.ChebyshevFilter(block=4)), VOLUME),
    "mirror": (lambda T: signature(grid(T), "block-lanczos", "mirror"), PLANE),
    "mean": (lambda T: signature(grid(T), "dense", "mean"), PLANE),
    "surface": (lambda v: signature(surface(v), "block-lanczos"), SPHERE.vertices),
    "solid": (lambda v: signature(solid(v), "dense", "dirichlet"), BALL.vertices),
    "signatures": (signatures, PLANE),
    "count": (lambda T: hj.count_eigenvalues(grid(T), 1.0), PLANE),
    "colouring": (lambda T: hj.hks_spectrum_free(grid(T), TIMES, method=COLOURING), PLANE),
    "selected inversion": (lambda T: hj.hks_spectrum_free(grid(T), TIMES, method="selected-inversion"), PLANE),
    "curvature": (lambda T: hj.gaussian_curvature(grid(T)), PLANE),
    "scalar curvature": (lambda T: hj.scalar_curvature(grid(T)), VOLUME),
    "expansion": (lambda T: hj.hks_expansion(grid(T), TIMES), PLANE),
    "Laplace–Beltrami": (lambda T: hj.laplace_beltrami(grid(T), jnp.ones(T.shape[:2])), PLANE),
    "eigsh": (lambda T: hj.eigsh(hj.assemble(grid(T)), k=6, solver=hj.BlockLanczos(block=2)).eigenvalues, PLANE),
    "eigh": (lambda T: hj.eigh(T[0, 0])[0], PLANE),
    "matrix function": (lambda T: hj.matrix_function(T[0, 0], jnp.exp), PLANE),
    "batch": (lambda T: jax.vmap(lambda T: signature(grid(T), "block-lanczos"))(jnp.stack([T, T])), PLANE),
}
DIFFERENTIATED = ["dense", "block Lanczos", "filter", "mirror", "surface", "colouring", "selected inversion", "batch"]


def cases(names):
    """All slow but the first."""
    return [names[0], *(pytest.param(name, marks=pytest.mark.slow) for name in names[1:])]


def lowered(function, example):
    return export.export(jax.jit(function), platforms=["cuda"])(jax.ShapeDtypeStruct(example.shape, example.dtype))


@pytest.mark.parametrize("name", cases(list(COMPUTATIONS)))
def test_values_are_lowered(name):
    assert lowered(*COMPUTATIONS[name]).platforms == ("cuda",)


@pytest.mark.parametrize("name", cases(DIFFERENTIATED))
def test_gradients_are_lowered(name):
    function, example = COMPUTATIONS[name]
    gradient = jax.grad(lambda x: jnp.nansum(function(x) ** 2))
    assert lowered(gradient, example).platforms == ("cuda",)


@pytest.mark.slow
def test_a_product_of_gauss_newton_is_lowered():
    def product(T):
        function = COMPUTATIONS["block Lanczos"][0]
        _, push = jax.linearize(function, T)
        return jax.vjp(function, T)[1](push(T))[0]

    assert lowered(product, PLANE).platforms == ("cuda",)
