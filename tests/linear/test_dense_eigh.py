"""Eigenpairs of dense symmetric matrices against SciPy's, and their derivatives at multiple eigenvalues."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from annotations import unchecked
from differences import directional
from scipy import linalg

import hks_jax as hj

VALUES = np.array([1.0, 1.0, 1.0, 2.0, 3.0, 3.0, 5.0])
N = len(VALUES)


def symmetric(rng):
    M = rng.standard_normal((N, N))
    return M + M.T


def with_spectrum(rng, values=VALUES):
    frame = np.linalg.qr(rng.standard_normal((N, N)))[0]
    A = frame @ np.diag(values) @ frame.T
    return (A + A.T) / 2


def pencil(rng):
    """A and B whose eigenvalues are VALUES."""
    root = with_spectrum(rng, np.linspace(0.5, 1.5, N))
    return root @ with_spectrum(rng) @ root, root @ root


def projector_derivative(A, centre, radius, E):
    """Of the projector on the eigenvalues in a circle: a contour integral of resolvents."""
    z = centre + radius * np.exp(2j * np.pi * (np.arange(64) + 0.5) / 64)
    resolvents = np.linalg.inv(z[:, None, None] * np.eye(N) - A)
    return np.einsum("z,zij,jk,zkl->il", (z - centre) / 64, resolvents, E, resolvents).real


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_eigenpairs_agree_with_scipy(rng, dtype):
    A, B = pencil(rng)
    tolerance = 50 * np.finfo(dtype).eps
    for matrices in ((A,), (A, B)):
        pairs = hj.eigh(*(matrix.astype(dtype) for matrix in matrices))
        assert pairs.eigenvalues.dtype == pairs.eigenvectors.dtype == dtype
        values, vectors = (np.asarray(each, np.float64) for each in pairs)
        expected = linalg.eigh(*matrices, eigvals_only=True)
        np.testing.assert_allclose(values, expected, atol=10 * tolerance)
        mass = B if len(matrices) == 2 else np.eye(N)
        np.testing.assert_allclose(vectors.T @ mass @ vectors, np.eye(N), atol=tolerance)
        np.testing.assert_allclose(A @ vectors, mass @ vectors * values, atol=10 * tolerance)


def test_sums_over_multiplets_have_exact_gradients(rng):
    """tr e^A of seven equal eigenvalues, and tr f(B⁻¹A) of a pencil with a triple and a double one."""
    gradient = jax.jit(jax.grad(lambda A: jnp.sum(jnp.exp(hj.eigh(A).eigenvalues))))
    for A in (np.eye(N), with_spectrum(rng)):
        np.testing.assert_allclose(gradient(A), linalg.expm(A), atol=1e-12 * np.exp(5))

    A, B = pencil(rng)
    E, F = symmetric(rng), symmetric(rng)
    along = jax.jvp(lambda A, B: jnp.sum(jnp.sin(hj.eigh(A, B).eigenvalues)), (A, B), (E, F))[1]
    slope = directional(
        lambda h: np.sum(np.sin(linalg.eigh(A + h * E, B + h * F, eigvals_only=True))), 0.0, 1.0, step=1e-3
    )
    assert along == pytest.approx(slope, rel=1e-8)


@pytest.mark.parametrize(("noise", "tolerance"), [(0.0, 2e-13), (1e-12, 1e-3), (1e-9, 1e-6), (1e-6, 1e-9)])
def test_projectors_on_multiplets_have_exact_derivatives(rng, noise, tolerance):
    """With noise, unless a tolerance declares the cluster a multiplet, to what is left of the eigenvectors' digits."""
    A, E = with_spectrum(rng) + noise * symmetric(rng), symmetric(rng)
    expected = projector_derivative(A, 1.0, 0.5, E)
    for setting, accurate_to in ((None, tolerance), (1e-4, 2e-13)):

        def projector(A, setting=setting):
            vectors = hj.eigh(A, multiplet_tolerance=setting).eigenvectors[:, :3]
            return vectors @ vectors.T

        slope = jax.jvp(projector, (A,), (E,))[1]
        np.testing.assert_allclose(slope, expected, atol=accurate_to * np.abs(expected).max())
        gradient = jax.grad(lambda A, projector=projector: jnp.vdot(projector(A), E))(A)
        np.testing.assert_allclose(gradient, expected, atol=accurate_to * np.abs(expected).max())


@pytest.mark.slow
def test_simple_eigenpairs_have_exact_derivatives_beside_multiple_ones(rng):
    """Of a pencil, with respect to both matrices; the eigenvector's sign is fixed by one entry."""
    A, B = pencil(rng)
    E, F, w = symmetric(rng), symmetric(rng), rng.standard_normal(N)

    def loss(A, B):
        values, vectors = hj.eigh(A, B)
        return values[3] + jnp.dot(w, vectors[:, 3]) * jnp.sign(vectors[0, 3])

    def reference(h):
        values, vectors = linalg.eigh(A + h * E, B + h * F)
        return values[3] + np.dot(w, vectors[:, 3]) * np.sign(vectors[0, 3])

    slope = directional(reference, 0.0, 1.0, step=1e-3)
    assert jax.jvp(loss, (A, B), (E, F))[1] == pytest.approx(slope, rel=1e-7)
    gradients = jax.jit(jax.grad(loss, (0, 1)))(A, B)
    assert jnp.vdot(gradients[0], E) + jnp.vdot(gradients[1], F) == pytest.approx(slope, rel=1e-7)
    stacked = jax.vmap(jax.grad(loss))(jnp.stack([A, 2 * A]), jnp.stack([B, B]))
    np.testing.assert_allclose(stacked[0], gradients[0], atol=1e-11)


def test_derivatives_of_all_vectors_are_finite_and_keep_them_orthonormal(rng):
    A, E = np.eye(N), symmetric(rng)
    d_values, d_vectors = jax.jvp(hj.eigh, (A,), (E,))[1]
    np.testing.assert_array_equal(d_vectors, 0)
    np.testing.assert_allclose(d_values.sum(), np.trace(E))
    A = with_spectrum(rng)
    (_, vectors), (_, d_vectors) = jax.jvp(hj.eigh, (A,), (E,))
    np.testing.assert_allclose(d_vectors.T @ vectors + vectors.T @ d_vectors, 0, atol=1e-12)


def test_second_derivatives_are_exact_or_not_a_number(rng):
    E = symmetric(rng)

    def entropy(A):
        values, vectors = hj.eigh(A)
        return jnp.sum(values * jnp.log(values)) + jnp.sum(vectors[:, 0] ** 4)

    gradient = jax.jit(jax.grad(entropy))
    hessian = jax.jit(lambda A: jax.jvp(gradient, (A,), (E,))[1])
    simple = with_spectrum(rng, np.arange(1.0, N + 1))
    slope = directional(lambda h: np.vdot(gradient(simple + h * E), E), 0.0, 1.0, step=1e-3)
    assert jnp.vdot(hessian(simple), E) == pytest.approx(slope, rel=1e-7)
    assert np.isnan(hessian(with_spectrum(rng))).any()


def test_bad_matrices_are_refused_by_name(rng):
    A = with_spectrum(rng)
    skew, missing = A.copy(), A.copy()
    skew[4, 1] += 0.25
    missing[2, 3] = np.nan
    with unchecked():
        for value, message in (
            (skew, r"A: not symmetric: entry \(1, 4\) is .*, and entry \(4, 1\) differs .* Pass \(A \+ A.T\) / 2"),
            (missing, "A: 1 of .* entries are NaN or infinite; expected finite numbers"),
            (A[:3], r"A: got shape \(3, 7\); expected \(n, n\)"),
            (np.stack([A, A]), r"A: got shape \(2, 7, 7\); expected \(n, n\)\. Use jax.vmap"),
            (A + 0j, "A: got complex numbers"),
        ):
            with pytest.raises(ValueError, match=message):
                hj.eigh(value)
        with pytest.raises(ValueError, match="B: not symmetric"):
            hj.eigh(A, skew)
        with pytest.raises(ValueError, match=r"B: got float32\[7, 7\]; expected float64\[7, 7\], as for A"):
            hj.eigh(A, A.astype(np.float32))
        with pytest.raises(ValueError, match=r"B: got a matrix whose least eigenvalue is -1;"):
            hj.eigh(A, with_spectrum(rng, np.arange(-1.0, N - 1)))
        with pytest.raises(ValueError, match="multiplet_tolerance: got -1"):
            hj.eigh(A, multiplet_tolerance=-1.0)
    # Noise is allowed, and its symmetric part taken; integers are numbers.
    np.testing.assert_allclose(hj.eigh(A + 1e-10 * rng.standard_normal((N, N))).eigenvalues, VALUES, atol=1e-8)
    np.testing.assert_allclose(hj.eigh(np.diag(np.arange(3))).eigenvalues, [0, 1, 2], atol=1e-15)
    assert hj.eigh(np.eye(3, dtype=np.float16)).eigenvalues.dtype == np.float32
    # What is traced cannot be looked at.
    assert np.isnan(jax.jit(hj.eigh)(A, -np.eye(N)).eigenvalues).all()
    assert np.isnan(jax.jit(hj.eigh)(missing).eigenvalues).all()
