"""Derivatives outside of `jax.jit`, which are programs of their own or NumPy's, against those within it, JAX's."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from fields import random_spd

import hks_jax as hj

SHAPE = (6, 5)
MASK = np.ones(SHAPE, bool)
MASK[:2, :2] = MASK[-1, -1] = False


def integrals(tensors, boundary="neumann", interpolation="linear"):
    """Some numbers that depend on all entries of both matrices, nonlinearly."""
    field = hj.TensorField(hj.Grid(SHAPE, 0.15, mask=MASK), tensors, interpolation=interpolation)
    pencil = hj.assemble(field, boundary)
    entries = jnp.stack([pencil.stiffness.flat(), pencil.mass.flat(), jnp.full(9 * 30, pencil.volume)])
    return jnp.sum(jnp.sin(entries + jnp.arange(9.0 * 30, dtype=entries.dtype)[None]), axis=1)


def close(found, expected, digits=1e-11):
    np.testing.assert_allclose(found, expected, rtol=0, atol=digits * np.abs(expected).max())


@pytest.mark.slow
@pytest.mark.parametrize(
    ("boundary", "interpolation"),
    [(("periodic", "dirichlet"), "linear"), ("neumann", "log-euclidean")],
)
def test_assembly_is_differentiated_as_within_jit(boundary, interpolation):
    rng = np.random.default_rng(0)
    x, change = jnp.asarray(random_spd(rng, SHAPE, 0.3)), jnp.asarray(rng.standard_normal((*SHAPE, 2, 2)))

    def f(x):
        return integrals(x, boundary, interpolation)

    value, of_change = jax.jvp(f, (x,), (change,))
    jacobian, hessian = jax.jit(lambda x: (jax.jacrev(f)(x), jax.jvp(jax.jacrev(f), (x,), (change,))[1]))(x)
    close(value, jax.jit(f)(x))
    close(of_change, jnp.tensordot(jacobian, change, 4))
    close(jax.jacrev(f)(x), jacobian)
    close(jax.jacfwd(f)(x), jacobian)
    close(jax.jit(jax.vjp(f, x)[1])(jnp.ones(3))[0], jacobian.sum(axis=0))
    close(jax.vmap(jax.grad(lambda x: f(x).sum()))(jnp.stack([x, x]))[1], jacobian.sum(axis=0))
    close(jax.jvp(jax.jacrev(f), (x,), (change,))[1], hessian)
    close(jax.grad(lambda y: jnp.vdot(jax.vjp(f, y)[1](jnp.ones(3))[0], change))(x), hessian.sum(axis=0))
    assert jax.grad(lambda x: f(x).sum())(x.astype(np.float32)).dtype == np.float32


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore::hks_jax.AccuracyWarning")
def test_signatures_of_doubled_domains_are_differentiated_as_within_jit():
    rng = np.random.default_rng(0)
    x, change = jnp.asarray(random_spd(rng, SHAPE, 0.3)), jnp.asarray(rng.standard_normal((*SHAPE, 2, 2)))

    def f(x):
        field = hj.TensorField(hj.Grid(SHAPE, 0.15, mask=MASK), x)
        pairs = hj.eigenpairs(field, 7, "mean", solver="shift-invert")
        return hj.hks(pairs, jnp.array([0.01, 0.3]))[:, 2:, 1:-1]

    def both(x):
        y, forward = jax.jvp(f, (x,), (change,))
        return forward, jax.vjp(f, x)[1](jnp.cos(y))[0]

    for found, expected in zip(both(x), jax.jit(both)(x), strict=True):
        close(found, expected, 1e-9)
