"""A linear map in a derivative rule: the same numbers by NumPy, by one compiled program, and traced."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from hks_jax.linear.linear_program import HostMap, linear_program

A = np.random.default_rng(0).normal(size=(3, 4))
X, Y = np.arange(1.0, 5), np.array([1.0, -2, 3])
CALLS = []


def product(power, matrix, x):
    CALLS.append("traced")
    return matrix**power @ x["x"]


def by_numpy(power, matrix):
    of_numpy = np.asarray(matrix) ** power

    def apply(x):
        CALLS.append("apply")
        return of_numpy @ np.asarray(x["x"])

    def transpose(like, y):
        CALLS.append("transpose")
        assert like["x"].shape == (4,)
        return {"x": of_numpy.T @ y, "names": None}

    return HostMap(apply, transpose)


def apply(x, matrix=A, host_map=by_numpy):
    given = {"x": x, "names": np.arange(4)}  # integers have no derivative, and the map does not see them
    return linear_program(product, (2,), (jnp.asarray(matrix),), given, jax.ShapeDtypeStruct((3,), float), host_map)


@pytest.mark.parametrize("host_map", [by_numpy, None, lambda power, matrix: None])
@pytest.mark.parametrize(
    ("use", "wanted"),
    [
        (lambda f: f(jnp.asarray(X)), A**2 @ X),
        (lambda f: jax.jvp(f, (X,), (2 * X,))[1], 2 * A**2 @ X),
        (lambda f: jax.vjp(f, X)[1](Y)[0], (A**2).T @ Y),
        (lambda f: jax.jit(jax.vjp(f, X)[1])(Y)[0], (A**2).T @ Y),
        (lambda f: jax.jacrev(f)(X), A**2),
        (lambda f: jax.jacfwd(f)(X), A**2),
        (lambda f: jax.hessian(lambda x: jnp.sum(f(x) ** 2))(X), 2 * (A**2).T @ A**2),
        (lambda f: jax.vmap(f)(jnp.stack([X, X])), np.stack([A**2 @ X] * 2)),
        (lambda f: jax.jit(f)(X), A**2 @ X),
        (lambda f: jax.grad(lambda x: jnp.sum(jnp.asarray(Y) * f(x)))(X), (A**2).T @ Y),
    ],
)
def test_every_transformation_gives_the_map(use, wanted, host_map):
    np.testing.assert_allclose(use(lambda x: apply(x, host_map=host_map)), wanted, rtol=1e-14)


def test_numpy_computes_what_is_known_and_xla_what_is_traced():
    def called(function, *args):
        CALLS.clear()
        function(*args)
        return set(CALLS)

    assert called(lambda: jax.vjp(apply, X)[1](Y)) == {"apply", "transpose"}
    assert called(jax.jit(lambda matrix: apply(X, matrix)), A) <= {"traced"}
    assert called(jax.grad(lambda matrix: jnp.sum(apply(X, matrix))), A) <= {"traced"}


def test_constants_are_not_kept_alive():
    matrix = jnp.asarray(A)
    before = {id(x) for x in jax.live_arrays()}
    jax.block_until_ready(jax.vjp(lambda x: apply(x, 2 * matrix), jnp.asarray(X))[1](jnp.asarray(Y)))
    assert not [x for x in jax.live_arrays() if id(x) not in before and x.shape == A.shape]
