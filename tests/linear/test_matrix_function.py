"""Functions of dense symmetric matrices against SciPy's and against differences, where eigenvalues are equal too."""

import re
import subprocess
import sys
from decimal import Decimal, getcontext
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from annotations import unchecked
from differences import directional
from scipy import linalg

import hks_jax as hj
from hks_jax.linear.divided_differences import divided_difference, second_divided_difference

SPECTRA = {
    "identity": [1.0] * 5,
    "multiple": [1.0, 1.0, 2.0, 2.0, 2.0],
    "close": [1.0, 1 + 1e-11, 1 + 1e-7, 1.001, 3.0],
    "apart": [0.1, 0.7, 2.0, 5.0, 9.0],
}


def symmetric(rng, n=5):
    M = rng.standard_normal((n, n))
    return M + M.T


def with_spectrum(rng, values):
    frame = np.linalg.qr(rng.standard_normal((len(values),) * 2))[0]
    A = frame @ np.diag(values) @ frame.T
    return (A + A.T) / 2


@pytest.mark.parametrize("values", SPECTRA.values(), ids=SPECTRA)
def test_exponential_logarithm_and_root_with_their_derivatives_agree_with_scipy(rng, values):
    A, E = with_spectrum(rng, values), symmetric(rng)
    exponential, slope = linalg.expm_frechet(A, E)
    got, got_slope = jax.jvp(lambda A: hj.matrix_function(A, jnp.exp), (A,), (E,))
    np.testing.assert_allclose(got, exponential, atol=1e-13 * np.abs(exponential).max())
    np.testing.assert_allclose(got_slope, slope, atol=1e-13 * np.abs(slope).max())
    gradient = jax.grad(lambda A: jnp.vdot(hj.matrix_function(A, jnp.exp), E))(A)
    np.testing.assert_allclose(gradient, slope, atol=1e-13 * np.abs(slope).max())
    np.testing.assert_allclose(hj.matrix_function(A, jnp.log), linalg.logm(A), atol=1e-12)
    # The derivative X of √A solves √A X + X √A = E, that of A⁻¹ is −A⁻¹EA⁻¹.
    root = linalg.sqrtm(A)
    got, got_slope = jax.jvp(lambda A: hj.matrix_function(A, jnp.sqrt), (A,), (E,))
    np.testing.assert_allclose(got, root, atol=1e-13)
    np.testing.assert_allclose(got_slope, linalg.solve_sylvester(root, root, E), atol=1e-12)
    got_slope = jax.jvp(lambda A: hj.matrix_function(A, lambda x: 1 / x), (A,), (E,))[1]
    inverse = np.linalg.inv(A)
    np.testing.assert_allclose(got_slope, -inverse @ E @ inverse, atol=1e-13 * np.abs(got_slope).max())


@pytest.mark.slow
@pytest.mark.parametrize("name", ["identity", "multiple", "close"])
def test_second_derivatives_in_every_order_of_modes(rng, name):
    """Of e^(−tA) as a function of t and A; JAX differentiates Padé's approximation by itself."""
    A, E, F, W = with_spectrum(rng, SPECTRA[name]), *(symmetric(rng) for _ in range(3))

    def ours(t, A):
        return jnp.vdot(W, hj.matrix_function(A, lambda x: jnp.exp(-t * x)))

    def reference(t, A):
        return jnp.vdot(W, jax.scipy.linalg.expm(-t * A))

    def forward(f, along):
        return lambda t, A: jax.jvp(f, (t, A), along)[1]

    def reverse(f, along):
        def slope(t, A):
            gradient = jax.grad(f, (0, 1))(t, A)
            return gradient[0] * along[0] + jnp.vdot(gradient[1], along[1])

        return slope

    t, one, two = 0.7, (1.3, jnp.asarray(E)), (-0.4, jnp.asarray(F))
    expected = forward(forward(reference, one), two)(t, A)
    for inner in (forward, reverse):
        for outer in (forward, reverse):
            got = jax.jit(outer(inner(ours, one), two))(t, A)
            np.testing.assert_allclose(got, expected, rtol=1e-11, err_msg=f"{outer.__name__} over {inner.__name__}")


@pytest.mark.slow
def test_hessian_at_the_identity_is_the_textbooks():
    """W·f(I + hD) = W·(f(1) + h f'(1) D + h² f''(1) D²/2 + …)."""
    W = jnp.asarray([[0.3, 0.7], [0.7, -1.1]])
    hessian = jax.hessian(lambda A: jnp.vdot(W, hj.matrix_function(A, jnp.log)))(jnp.eye(2))
    D = jnp.asarray([[0.4, -0.2], [-0.2, 1.5]])
    got = jnp.einsum("ijkl,ij,kl", hessian, D, D)
    np.testing.assert_allclose(got, -jnp.vdot(W, D @ D), rtol=1e-13)


@pytest.mark.slow
def test_third_derivatives_are_refused():
    def along(f):
        return lambda A: jax.jvp(f, (A,), (jnp.ones((2, 2)),))[1]

    with pytest.raises(NotImplementedError, match="third derivatives of matrix functions"):
        along(along(along(lambda A: hj.matrix_function(A, jnp.exp))))(jnp.eye(2))


@pytest.mark.slow
@pytest.mark.parametrize("double", [True, pytest.param(False, marks=pytest.mark.slow)])
def test_of_a_pencil_it_is_f_of_the_quotient_times_the_inverse(rng, double):
    """f(B⁻¹A) B⁻¹ = B^(−½) f(B^(−½) A B^(−½)) B^(−½), here with A of three equal eigenvalues against B."""
    root = with_spectrum(rng, [0.5, 0.8, 1.0, 1.4, 2.0])
    B, A = root @ root, root @ with_spectrum(rng, [2.0, 2.0, 2.0, 3.0, 4.0]) @ root
    E, F, W = symmetric(rng), symmetric(rng), symmetric(rng)

    def kernel(A, B):
        return linalg.expm(-0.3 * linalg.solve(B, A)) @ np.linalg.inv(B)

    dtype, tolerance = (np.float64, 1e-10) if double else (np.float32, 1e-4)
    A32, B32 = A.astype(dtype), B.astype(dtype)
    value = hj.matrix_function(A32, lambda x: jnp.exp(-0.3 * x), B32)
    assert value.dtype == dtype
    np.testing.assert_allclose(value, kernel(A, B), atol=tolerance)
    gradients = jax.grad(
        lambda A, B: jnp.vdot(W.astype(dtype), hj.matrix_function(A, lambda x: jnp.exp(-0.3 * x), B)), (0, 1)
    )(A32, B32)
    slope = directional(lambda h: np.vdot(W, kernel(A + h * E, B + h * F)), 0.0, 1.0, step=1e-3)
    got = np.vdot(gradients[0], E) + np.vdot(gradients[1], F)
    assert got == pytest.approx(slope, rel=100 * tolerance)
    np.testing.assert_allclose(hj.matrix_function(A32, lambda x: 1.0, B32), np.linalg.inv(B), atol=10 * tolerance)


@pytest.mark.slow
def test_parameters_of_f_batched_compute_one_decomposition(rng):
    A, times = with_spectrum(rng, SPECTRA["multiple"]), jnp.array([0.1, 0.5, 2.0])

    def kernels(A, times):
        return jax.vmap(lambda t: hj.matrix_function(A, lambda x: jnp.exp(-t * x)))(times)

    expected = np.stack([linalg.expm(-t * A) for t in times])
    np.testing.assert_allclose(kernels(A, times), expected, atol=1e-14)
    assert str(jax.make_jaxpr(kernels)(A, times)).count(" eigh[") == 1
    slopes = jax.jvp(lambda t: kernels(A, t), (times,), (jnp.ones(3),))[1]
    np.testing.assert_allclose(slopes, -A @ expected, atol=1e-13)
    # batches of matrices, integers in f, and jit
    stack, powers = jnp.stack([A, 2 * A]), jnp.array([2, 3])
    got = jax.jit(jax.vmap(lambda A, p: hj.matrix_function(A, lambda x: jnp.power(x, p.astype(x.dtype)))))(
        stack, powers
    )
    np.testing.assert_allclose(got, np.stack([A @ A, 8 * A @ A @ A]), atol=1e-11)
    gradient = jax.vmap(
        jax.grad(lambda A, p: jnp.trace(hj.matrix_function(A, lambda x: jnp.power(x, p.astype(x.dtype)))))
    )(stack, powers)
    np.testing.assert_allclose(gradient, np.stack([2 * A, 12 * A @ A]), atol=1e-11)


@pytest.mark.slow
def test_shared_out_to_devices(rng):
    """One device will do; functions that close over an array, too."""
    stack, t = jnp.asarray([with_spectrum(rng, SPECTRA["multiple"])] * 2), jnp.asarray(0.3)
    mesh = jax.make_mesh((1,), ("devices",))

    def kernel(A):
        return hj.matrix_function(A, lambda x: jnp.exp(-t * x))

    run = jax.value_and_grad(lambda stack: jnp.trace(hj.devices.map_fields(kernel, stack, mesh)[1]))
    value, gradient = run(stack)
    expected = linalg.expm(-0.3 * np.asarray(stack[1]))
    np.testing.assert_allclose(value, np.trace(expected), rtol=1e-13)
    np.testing.assert_allclose(gradient, np.stack([0 * expected, -0.3 * expected]), atol=1e-13)


def test_steps_give_projectors(rng):
    """P on the eigenvalues below c, of which two are equal; its derivative by a contour integral of resolvents."""
    A, E = with_spectrum(rng, SPECTRA["multiple"]), symmetric(rng)
    got, slope = jax.jvp(lambda A: hj.matrix_function(A, lambda x: x < 1.5), (A,), (E,))
    z = 1 + 0.5 * np.exp(2j * np.pi * (np.arange(64) + 0.5) / 64)
    resolvents = np.linalg.inv(z[:, None, None] * np.eye(5) - A)
    np.testing.assert_allclose(got, np.einsum("z,zij->ij", (z - 1) / 64, resolvents).real, atol=1e-13)
    along = np.einsum("z,zij,jk,zkl->il", (z - 1) / 64, resolvents, E, resolvents).real
    np.testing.assert_allclose(slope, along, atol=1e-12)


def decimal_tanh(x):
    power = (2 * x).exp()
    return (power - 1) / (power + 1)


@pytest.mark.parametrize(
    ("f", "exact"),
    [
        pytest.param(jnp.exp, Decimal.exp, id="exp"),
        pytest.param(lambda x: 1 / (1 + x * x), lambda x: 1 / (1 + x * x), id="1/(1 + x²)"),
        pytest.param(jnp.tanh, decimal_tanh, id="tanh", marks=pytest.mark.slow),
    ],
)
@pytest.mark.parametrize("scale", [pytest.param(1, marks=pytest.mark.slow), 30])
def test_second_divided_differences(f, exact, scale):
    """Against the quotients in 60 digits where all three are apart or close, and f''/2 where they are equal."""
    getcontext().prec = 60

    def scaled(x):
        return f(scale * x)

    base = np.array([-0.3, 0.0, 0.01, 0.4])
    size = jnp.asarray(float(scale))
    for gap in (1.0, 1e-2, 1e-5, 1e-9, 1e-13):
        triples = base + gap * np.array([[0.0], [0.3], [1.0]])
        a, b, c = jnp.asarray(triples)
        below, above = divided_difference(scaled, a, b), divided_difference(scaled, b, c)
        got = second_divided_difference(scaled, a, b, c, below, above, size)
        x, y, z = np.vectorize(lambda v: Decimal(float(v)))(triples)
        u, v, w = (np.vectorize(lambda v: exact(scale * v))(each) for each in (x, y, z))
        expected = (((w - v) / (z - y) - (v - u) / (y - x)) / (z - x)).astype(float)
        curvature = scale**2 * np.maximum(1, np.abs(scaled(c)))
        np.testing.assert_array_less(np.abs(got - expected) / curvature, 1e-11, err_msg=f"gap {gap}")
    same = jnp.asarray(base)
    equal = second_divided_difference(scaled, *[same] * 3, *[jnp.zeros(4)] * 2, size)
    np.testing.assert_allclose(equal, jax.vmap(jax.grad(jax.grad(scaled)))(same) / 2, atol=1e-13 * scale**2)


@pytest.mark.slow
def test_the_example_of_the_reference_prints_what_it_says():
    page = (Path(__file__).parents[2] / "docs" / "reference" / "dense.md").read_text(encoding="utf-8")
    (code,) = re.findall(r"```python\n(.*?)```", page, re.DOTALL)
    promised = re.findall(r"print\(.*\)  # (.*)", code)

    def numbers(lines):
        return [float(word) for line in lines for word in line.strip("[]").split()]

    done = subprocess.run([sys.executable, "-W", "error", "-c", code], capture_output=True, text=True, check=True)
    assert len(numbers(promised)) == 7
    np.testing.assert_allclose(numbers(done.stdout.splitlines()), numbers(promised), rtol=1e-6)


def test_errors():
    with unchecked():
        for f in (lambda x: jnp.stack([x, x]), lambda x: jax.lax.complex(x, x), lambda x: (x, x)):
            with pytest.raises(ValueError, match=r"f: returned .* for one eigenvalue; expected a real scalar"):
                hj.matrix_function(jnp.eye(2), f)
        with pytest.raises(ValueError, match="A: not symmetric"):
            hj.matrix_function(np.array([[1.0, 2.0], [3.0, 4.0]]), jnp.exp)
    assert np.isnan(hj.matrix_function(-jnp.eye(2), jnp.log)).any()
