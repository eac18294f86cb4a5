"""Maps in modes: exactness in the mass inner product on every domain, filters, unmeasured nodes, derivatives."""

import warnings

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from differences import directional
from fields import flat, random_spd

import hks_jax as hj

SHAPE = (7, 6)
MASK = np.ones(SHAPE, bool)
MASK[5:, 4:] = False
TENSORS = random_spd(np.random.default_rng(1), SHAPE)
GRID = hj.Grid(SHAPE, (0.2, 0.3), mask=MASK)
FIELD = hj.TensorField(GRID, TENSORS)


def solid():
    mask = np.ones((4, 4, 5), bool)
    mask[2:, 2:, 3:] = False
    return hj.TensorField(hj.Grid((4, 4, 5), 0.5, mask=mask), random_spd(np.random.default_rng(2), (4, 4, 5), 0.5))


def cap():
    mesh = hj.examples.sphere_mesh(2)
    return hj.SurfaceMesh(mesh.vertices, mesh.faces, mask=np.asarray(mesh.vertices)[:, 2] > -0.4)


PENCILS = {
    "neumann": lambda: hj.assemble(FIELD),
    "dirichlet": lambda: hj.assemble(FIELD, "dirichlet"),
    "lumped": lambda: hj.assemble(FIELD, mass="lumped"),
    "mirror": lambda: hj.assemble(FIELD, ("neumann", "mirror")),
    "mean": lambda: hj.assemble(FIELD, "mean"),
    "cancelling": lambda: hj.assemble(FIELD, quadrature="cancelling"),
    "cancelling mean": lambda: hj.assemble(FIELD, "mean", quadrature="cancelling"),
    "fick": lambda: hj.assemble(hj.TensorField.from_diffusion(GRID, TENSORS, operator="fick")),
    "potential": lambda: hj.assemble(FIELD, potential=lambda x: -3 * x[0]),
    "volume": lambda: hj.assemble(solid()),
    "surface": lambda: hj.assemble(cap()),
    "surface mean": lambda: hj.assemble(cap(), "mean"),
    "quadratic": lambda: hj.assemble(hj.examples.sphere_mesh(1), degree=2),
    "tetrahedra": lambda: hj.assemble(hj.examples.ball_mesh(2)),
    "matrix": lambda: hj.sparse_pencil(np.diag([1.0, 2.0, 5.0, 7.0, 7.0, 8.0, 9.0, 11.0, 14.0, 20.0]) + 0.1),
}
QUICK = {"mean", "surface", "tetrahedra"}
MADE = {}


def on(*names):
    """Parametrise over domains; those not among the quick ones are slow for the compiler."""
    marked = [pytest.param(name, marks=[] if name in QUICK else pytest.mark.slow) for name in names]
    return pytest.mark.parametrize("name", marked)


def pairs_of(name, k=9):
    if name not in MADE:
        MADE[name] = hj.eigenpairs(PENCILS[name](), k, solver="dense", multiplet="drop")
    return MADE[name]


def maps(pairs, rng, n=2):
    """Random maps at the nodes, NaN outside the domain."""
    values = rng.standard_normal((n, *pairs.space.node_shape))
    return np.where(pairs.space.domain, values, np.nan)


def inner(pairs, u, v):
    """∫uv over the domain by SciPy's matrices; at nodes of cancelling elements, by the row sums."""
    part = pairs.pencil.parts[0]
    u, v = (np.asarray(pairs.space.restrict(jnp.asarray(x))) for x in (u, v))
    if part.row_sums is not None:
        return np.einsum("...n,n,...n->...", u, np.asarray(part.row_sums), v)
    return np.einsum("...n,...n->...", u, (part.mass.to_scipy() @ v.reshape(-1, v.shape[-1]).T).T.reshape(v.shape))


def even(pairs):
    return np.asarray(pairs.kept) & (np.asarray(pairs.problem_numbers) == 0)


@on(*PENCILS)
def test_modes_are_orthonormal_in_the_mass_and_a_reconstruction_is_the_projection(name, rng):
    pairs = pairs_of(name)
    used, n_parts = even(pairs), len(pairs.pencil.parts)
    own = hj.decompose(pairs, pairs.eigenfunctions[used])
    np.testing.assert_allclose(own, np.eye(pairs.k)[used], atol=1e-11)
    f = maps(pairs, rng)
    c = hj.decompose(pairs, f)
    assert c.shape == (2, pairs.k)
    g = np.asarray(hj.reconstruct(pairs, c))
    np.testing.assert_array_equal(np.isnan(g[0]), ~pairs.space.domain)
    assert (g[:, pairs.space.domain & ~pairs.space.free] == 0).all()
    # The residual is orthogonal to all modes, and decomposing again changes nothing.
    modes = np.asarray(pairs.eigenfunctions)[used]
    left = np.nan_to_num(f - g)
    for mode in modes:
        np.testing.assert_allclose(inner(pairs, left, np.nan_to_num(mode)[None]), 0, atol=1e-11)
    np.testing.assert_allclose(hj.decompose(pairs, g), c, atol=1e-11)
    if pairs.pencil.parts[0].row_sums is None:
        np.testing.assert_allclose(c[:, used], n_parts * inner(pairs, np.nan_to_num(f)[:, None], np.nan_to_num(modes)))


@on(*PENCILS)
def test_energies_and_residuals_add_up(name, rng):
    pairs = pairs_of(name)
    f = np.nan_to_num(maps(pairs, rng))
    found = hj.energy(pairs, f)
    np.testing.assert_allclose(found.total, inner(pairs, f, f))
    c = np.asarray(found.coefficients)
    np.testing.assert_array_equal(c, hj.decompose(pairs, f))
    for m in (1, 4, pairs.k):
        left = f - np.nan_to_num(hj.reconstruct(pairs, c[:, :m]))
        np.testing.assert_allclose(found.residual[:, m - 1], inner(pairs, left, left), rtol=1e-10)
    if pairs.pencil.parts[0].row_sums is None:
        np.testing.assert_allclose(found.energy.sum(axis=1) + found.residual[:, -1], found.total)
    one = np.where(pairs.space.free, 1.0, 0)[None]
    mean = inner(pairs, f, one) / inner(pairs, one, one)
    variance = inner(pairs, f, f) - mean**2 * inner(pairs, one, one)
    np.testing.assert_allclose(found.explained, 1 - np.asarray(found.residual) / variance[:, None], atol=1e-10)


@on("neumann", "mean", "cancelling", "cancelling mean", "fick", "volume", "surface mean")
def test_filters_are_heat_flow_and_spectral_signatures(name, rng):
    pairs = pairs_of(name)
    f = maps(pairs, rng)
    t = jnp.asarray([2.0, 3.0])
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", hj.AccuracyWarning)
        flow = np.asarray(hj.heat_flow(pairs, t, f))
    np.testing.assert_allclose(hj.spectral_filter(pairs, f, lambda t, x: jnp.exp(-t * x), t), flow, atol=1e-13)
    np.testing.assert_allclose(hj.spectral_filter(pairs, f[0], decay), flow[0, 0], atol=1e-13)
    # A filter multiplies coefficients; for cancelling elements only up to their error.
    c = np.asarray(hj.decompose(pairs, f)) * np.asarray(decay(pairs.eigenvalues))
    at_most = 1e-11 if pairs.pencil.parts[0].row_sums is None else 2e-2
    np.testing.assert_allclose(hj.reconstruct(pairs, c), flow[0], atol=at_most)
    # The columns of the filter are those of the signature: a map that is 1/weight at one node.
    if pairs.pencil.parts[0].row_sums is None and len(pairs.problems) == 1:
        node = tuple(np.argwhere(pairs.space.free)[4])
        mass = np.asarray(pairs.pencil.mass.to_dense())
        delta = np.asarray(pairs.space.extend(jnp.asarray(np.linalg.inv(mass)[4]), outside=0.0))
        expected = hj.spectral_signature(pairs, decay_over, jnp.ones(1), [node])
        np.testing.assert_allclose(hj.spectral_filter(pairs, delta, decay), expected[0, 0], atol=1e-10)


def decay(x):
    return jnp.exp(-2 * x)


def decay_over(p, x):
    return jnp.exp(-2 * p * x)


# --- unmeasured nodes ---------------------------------------------------------------------------------------


@on("neumann", "dirichlet", "mean", "cancelling", "volume", "surface", "tetrahedra")
def test_a_sum_of_modes_is_recovered_from_the_measured_nodes(name, rng):
    pairs = pairs_of(name)
    c = np.where(even(pairs), rng.standard_normal(pairs.k), 0)
    f = np.array(hj.reconstruct(pairs, c))
    where = np.argwhere(pairs.space.free)
    for node in rng.choice(where, max(2, len(where) // 10), replace=False):
        f[tuple(node)] = np.nan
    found = hj.decompose(pairs, f)
    np.testing.assert_allclose(found, c, atol=1e-8)
    np.testing.assert_allclose(hj.energy(pairs, f).residual[-1], 0, atol=1e-14)
    whole = np.asarray(hj.reconstruct(pairs, c))
    expected = np.nan_to_num(hj.spectral_filter(pairs, whole, decay))
    np.testing.assert_allclose(np.nan_to_num(hj.spectral_filter(pairs, f, decay)), expected, atol=1e-8)


def test_the_fit_to_measured_nodes_is_least_squares_in_the_mass(rng):
    pairs = pairs_of("neumann", 9)
    f = maps(pairs, rng)
    f[:, 1:3, 2] = np.nan
    f[:, 4, 4] = np.nan
    rows = np.asarray(pairs.space.restrict(jnp.asarray(f)))
    known = ~np.isnan(rows[0])
    M, modes = pairs.pencil.mass.to_scipy().toarray()[np.ix_(known, known)], np.asarray(pairs.vectors)[:, known]
    root = np.linalg.cholesky(M).T
    expected = np.linalg.lstsq(root @ modes.T, root @ rows[:, known].T)[0].T
    np.testing.assert_allclose(hj.decompose(pairs, f), expected, atol=1e-11)
    np.testing.assert_allclose(jax.jit(hj.decompose)(pairs, f), expected, atol=1e-11)
    found = hj.energy(pairs, f)
    for m in (2, 9):
        left = rows[:, known] - expected[:, :m] @ modes[:m]
        np.testing.assert_allclose(found.residual[:, m - 1], np.einsum("sn,nm,sm->s", left, M, left))


def test_maps_that_cannot_be_decomposed(rng):
    pairs = pairs_of("neumann")
    f = maps(pairs, rng)
    f[0, 2, 2] = np.nan
    with pytest.raises(ValueError, match="f: got 1 nodes with NaN in only some of 2 maps"):
        hj.decompose(pairs, f)
    for both in (f, f[::-1]):
        assert np.isnan(jax.jit(hj.decompose)(pairs, both))[1].all()
    with pytest.raises(ValueError, match="f: got NaN at all nodes"):
        hj.decompose(pairs, np.full(SHAPE, np.nan))
    with pytest.raises(ValueError, match=r"f: got shape \(6, 7\); expected \(7, 6\)"):
        hj.energy(pairs, np.ones((6, 7)))
    with pytest.raises(ValueError, match="f: got 1 infinite"):
        hj.decompose(pairs, np.where(np.arange(42).reshape(SHAPE) == 8, np.inf, 1))
    few = np.full(SHAPE, np.nan)
    few[:2, :3] = 1
    with pytest.raises(ValueError, match=r"f: got 6 of 38 nodes measured, which do not determine.*9 modes"):
        hj.decompose(pairs, few)
    assert np.isnan(jax.jit(hj.decompose)(pairs, few)).all()
    half = np.where(np.arange(42).reshape(SHAPE) % 6 < 3, 1.0, np.nan)
    for call in (hj.decompose, hj.energy, lambda p, f: hj.surrogates(p, f, jax.random.key(0))):
        with pytest.warns(hj.AccuracyWarning, match="amplifies errors of f by up to") as said:
            call(pairs, half)
        assert sum("amplifies" in str(one.message) for one in said) == 1
    with pytest.raises(ValueError, match=r"c: got shape \(10,\); expected .* 1 to 9"):
        hj.reconstruct(pairs, np.ones(10))
    with pytest.raises(ValueError, match="parameters: got arrays of shapes"):
        hj.spectral_filter(pairs, f[1], decay_over, jnp.ones(()))


# --- wavelengths --------------------------------------------------------------------------------------------


@pytest.mark.parametrize("diffusivity", [0.7e-3, pytest.param(1.0, marks=pytest.mark.slow)])
def test_the_energy_of_a_plane_wave_is_at_its_wavelength_in_mm(diffusivity):
    """Two waves over 24 voxels of 2 mm have a length of 24 mm; with Fick's operator, t is in s."""
    grid = hj.Grid((24, 9), 2.0)
    D = np.broadcast_to(diffusivity * np.eye(2), (24, 9, 2, 2))
    f = np.broadcast_to(np.cos(4 * np.pi * np.arange(24) / 24)[:, None], (24, 9))
    for operator in ({"operator": "fick"}, {"metric": "inverse"}):
        pairs = hj.eigenpairs(hj.TensorField.from_diffusion(grid, D, **operator), 12, "periodic", multiplet="drop")
        found = hj.energy(pairs, f)
        at = np.argsort(np.asarray(found.energy))[-2:]  # cosine and sine
        assert found.energy[at].sum() == pytest.approx(float(found.total), rel=1e-9)
        np.testing.assert_allclose(found.wavelength[at], 24, rtol=0.02)
        assert found.wavelength[0] == np.inf
        # A Gaussian of this width halves the wave.
        sigma = np.asarray(found.fwhm)[at] / (2 * np.sqrt(2 * np.log(2)))
        half = np.exp(-np.asarray(pairs.eigenvalues)[at] * sigma**2 / (2 * diffusivity))
        np.testing.assert_allclose(half, 0.5, rtol=1e-9)
    given = hj.energy(pairs, f, diffusivity=4 * diffusivity)
    np.testing.assert_allclose(given.wavelength[1:], 2 * found.wavelength[1:])


@pytest.mark.parametrize("degree", [1, 2])
def test_wavelengths_on_a_mesh_are_lengths_whatever_the_unit_of_tensors(degree):
    sphere = hj.examples.sphere_mesh(2)
    tensors = np.tile(1e-3 * np.eye(3), (len(sphere.vertices), 1, 1))
    mesh = hj.SurfaceMesh.from_tensors(sphere.vertices, sphere.faces, tensors, metric="inverse")
    pairs = hj.eigenpairs(hj.assemble(mesh, degree=degree), 4)
    found = hj.energy(pairs, np.ones(pairs.space.node_shape))
    exact = hj.eigenpairs(hj.assemble(sphere, degree=degree), 4).eigenvalues  # of −Δ in space
    np.testing.assert_allclose(found.wavelength[1:], 2 * np.pi / np.sqrt(exact[1:]), rtol=1e-8)


@pytest.mark.parametrize("solid", [False, pytest.param(True, marks=pytest.mark.slow)])
def test_wavelengths_on_meshes_are_in_mm_whatever_the_tensors(solid):
    """The first wave along a bar of 24 mm has a wavelength of 48 mm; a tensor across a surface does not matter."""
    domain = bar(solid)
    x = np.asarray(domain.vertices)[:, 0]
    D = 0.7e-3 * np.diag([1.0, 1.0, 1.0 if solid else 50.0])
    for operator in ({"operator": "fick"}, {"metric": "inverse"}):
        made = type(domain).from_tensors(
            domain.vertices, domain.triangulation.cells, np.tile(D, (len(x), 1, 1)), **operator
        )
        found = hj.energy(hj.eigenpairs(made, 5, multiplet="drop"), np.cos(np.pi * x / 24))
        assert found.energy.argmax() == 1
        assert float(found.wavelength[1]) == pytest.approx(48, rel=0.02)


def bar(solid):
    """A bar of 24 × 6 (× 2) mm, of triangles or of tetrahedra."""
    n = (13, 4, 2) if solid else (13, 4, 1)
    places = np.stack(np.meshgrid(*(2.0 * np.arange(m) for m in n), indexing="ij"), -1).reshape(-1, 3)
    number = np.arange(len(places)).reshape(n)
    corner = [number[i : i + n[0] - 1, j : j + n[1] - 1].reshape(-1, n[2]) for i, j in np.ndindex(2, 2)]
    if not solid:
        a, b, c, d = (each[:, 0] for each in corner)
        return hj.SurfaceMesh(places, np.concatenate([np.stack([a, c, d], 1), np.stack([a, d, b], 1)]))
    cube = [corner[i][:, j] for i in range(4) for j in range(2)]  # the corner (i, j, k) has the number 4i + 2j + k
    paths = [(0, 4, 6, 7), (0, 6, 2, 7), (0, 2, 3, 7), (0, 3, 1, 7), (0, 1, 5, 7), (0, 5, 4, 7)]
    return hj.TetMesh(places, np.concatenate([np.stack([cube[i] for i in path], 1) for path in paths]))


def test_constants_have_no_variance():
    pairs = pairs_of("neumann")
    found = hj.energy(pairs, np.stack([np.ones(SHAPE), GRID.nodes[..., 0]]))
    assert np.isnan(found.explained[0]).all()
    assert np.isfinite(found.explained[1]).all()
    assert found.explained[1, 0] == pytest.approx(0, abs=1e-12)
    assert (np.diff(found.explained[1]) >= 0).all()


# --- transformations of JAX ---------------------------------------------------------------------------------


def coefficients(tensors, f):
    pairs = hj.eigenpairs(hj.TensorField(GRID, tensors), 6, solver="dense")
    return hj.decompose(pairs, f), hj.energy(pairs, f).energy


@pytest.mark.slow
@pytest.mark.parametrize("unmeasured", [False, True])
def test_derivatives_of_coefficients(unmeasured, rng):
    f = rng.standard_normal(SHAPE)
    if unmeasured:
        f[2, 1:3] = np.nan
    weights, direction = rng.standard_normal(6), rng.standard_normal((*SHAPE, 2, 2)) * 0.1
    direction = jnp.asarray(direction + np.swapaxes(direction, -1, -2))

    @jax.jit
    @jax.value_and_grad
    def loss(tensors):
        c, energies = coefficients(tensors, f)
        return jnp.sum(weights * c**2) + jnp.sum(energies**2)

    start, h = jnp.asarray(TENSORS), 1e-4
    ends = [float(loss(start + s * h * direction)[0]) for s in (1, -1, 2, -2)]
    difference = (8 * (ends[0] - ends[1]) - (ends[2] - ends[3])) / (12 * h)
    assert float(jnp.sum(loss(start)[1] * direction)) == pytest.approx(difference, rel=1e-6)


@pytest.mark.slow
def test_a_filter_has_derivatives_at_multiple_eigenvalues():
    square = flat((6, 6), (1.0, 1.0))
    f, rng = np.cos(np.arange(36.0)).reshape(6, 6), np.random.default_rng(3)
    direction = rng.standard_normal((6, 6, 2, 2))
    direction = jnp.asarray(direction + np.swapaxes(direction, -1, -2)) * 0.1

    def loss(x):
        tensors = square.tensors + x * direction
        pairs = hj.eigenpairs(hj.TensorField(square.grid, tensors), 36, solver="dense")
        return jnp.sum(hj.spectral_filter(pairs, f, lambda x: x / (1 + x)) ** 2)

    slope = jax.grad(loss)(0.0)
    assert float(slope) == pytest.approx(float(loss(1e-4) - loss(-1e-4)) / 2e-4, rel=1e-5)


@pytest.mark.slow
@pytest.mark.parametrize("name", ["mean", "cancelling"])
def test_compiled_and_where_rank_promotion_is_an_error(name, rng):
    pairs, f = pairs_of(name), maps(pairs_of(name), rng)
    calls = (
        hj.decompose,
        lambda p, f: hj.reconstruct(p, jnp.ones((2, 5))),
        lambda p, f: hj.energy(p, f).explained,
        lambda p, f: hj.spectral_filter(p, f, decay),
        lambda p, f: hj.surrogates(p, f, jax.random.key(0), 3),
    )
    with jax.numpy_rank_promotion("raise"), warnings.catch_warnings():
        warnings.simplefilter("ignore", hj.AccuracyWarning)
        for call in calls:
            np.testing.assert_allclose(jax.jit(call)(pairs, f), call(pairs, f), atol=1e-11)


@pytest.mark.slow
def test_under_vmap_and_in_single_precision(rng):
    pairs, f = pairs_of("mean"), maps(pairs_of("mean"), rng, 3)
    np.testing.assert_allclose(jax.vmap(lambda u: hj.decompose(pairs, u))(f), hj.decompose(pairs, f), atol=1e-13)
    batch = jax.jit(jax.vmap(lambda T: coefficients(T, f[0])[1]))(jnp.stack([TENSORS, 2 * TENSORS]))
    np.testing.assert_allclose(batch[1], coefficients(2 * TENSORS, f[0])[1], atol=1e-9)
    single = hj.eigenpairs(hj.TensorField(GRID, TENSORS.astype(np.float32)), 9, "mean", solver="dense")
    c = hj.decompose(single, f)
    assert c.dtype == hj.reconstruct(single, c).dtype == hj.energy(single, f).residual.dtype == np.float32
    g = hj.reconstruct(single, c)
    np.testing.assert_allclose(hj.decompose(single, g), c, atol=2e-5)
    assert hj.spectral_filter(single, f, decay).dtype == np.float32
    assert hj.surrogates(single, g, jax.random.key(0)).dtype == np.float32
    assert hj.align(single, single, ([[2, 2]], [[2, 2]])).pairs.vectors.dtype == np.float32


# --- surrogates ---------------------------------------------------------------------------------------------


def square_pairs(k=11):
    """The modes of a square with natural sides: simple and double eigenvalues."""
    return hj.eigenpairs(flat((8, 8), (1.0, 1.0)), k, solver="dense", multiplet="drop")


@pytest.mark.slow
def test_surrogates_keep_the_energy_of_each_multiplet_and_correlate_as_theory_says(rng):
    pairs = square_pairs()
    labels = np.asarray(pairs.multiplets)
    assert (np.bincount(labels) == 2).sum() >= 3
    c = np.where(pairs.kept, rng.standard_normal((2, pairs.k)), 0)
    f = hj.reconstruct(pairs, c)
    many = hj.surrogates(pairs, f, jax.random.key(1), n=4000)
    assert many.shape == (4000, 2, 8, 8)
    d = np.asarray(hj.decompose(pairs, many))
    for label in range(labels.max() + 1):
        own = labels == label
        # Also the inner products of the maps stay.
        gram = np.einsum("nai,nbi->nab", d[:, :, own], d[:, :, own])
        np.testing.assert_allclose(gram, np.broadcast_to(c[:, own] @ c[:, own].T, gram.shape), atol=1e-12)
    np.testing.assert_allclose(d[:, :, 0], np.broadcast_to(c[:, 0], (4000, 2)), atol=1e-12)  # the means
    size, share = np.bincount(labels[1:])[1:], np.zeros(labels.max())
    kept = c[0, 1:] ** 2
    share = np.bincount(labels[1:] - 1, kept) / kept.sum()
    correlation = d[:, 0, 1:] @ c[0, 1:] / kept.sum()
    theory = np.sum(share**2 / size)
    assert correlation.mean() == pytest.approx(0, abs=4 * np.sqrt(theory / 4000))
    # The fourth moment of the correlation is at most 3 times the squared variance.
    assert correlation.var() == pytest.approx(theory, rel=4 * np.sqrt(2 / 4000))


@pytest.mark.slow
def test_surrogates_of_given_groups_and_of_doubled_domains(rng):
    pairs = pairs_of("mean", 9)
    c = np.where(even(pairs), rng.standard_normal(9), 0)
    f = hj.reconstruct(pairs, c)
    groups = np.arange(9) // 5
    d = np.asarray(hj.decompose(pairs, jax.jit(lambda f: hj.surrogates(pairs, f, jax.random.key(0), 2, groups))(f)))
    for group in (0, 1):
        np.testing.assert_allclose((d[:, groups == group] ** 2).sum(1), (c[groups == group] ** 2).sum(), atol=1e-11)
    assert (d[:, ~even(pairs)] == 0).all()
    assert np.abs(d[0] - d[1]).max() > 0.1
    with pytest.raises(ValueError, match=r"groups: got .*; expected 9 integers"):
        hj.surrogates(pairs, f, jax.random.key(0), groups=np.arange(3))
    rough = np.indices(SHAPE).sum(axis=0) % 2.0
    with pytest.warns(hj.AccuracyWarning, match="f: 9.* of the variance lies beyond the 9 modes"):
        hj.surrogates(pairs, rough, jax.random.key(0))


# --- alignment ----------------------------------------------------------------------------------------------


def rotated(pairs, rng):
    """Return the pairs in other bases of their eigenspaces, and the matrix."""
    q, problems = np.zeros((pairs.k, pairs.k)), []
    labels, numbers = np.asarray(pairs.multiplets), np.asarray(pairs.problem_numbers)
    for label, number in {*zip(labels, numbers, strict=True)}:
        own = np.flatnonzero((labels == label) & (numbers == number))
        q[np.ix_(own, own)] = np.linalg.qr(rng.standard_normal((len(own), len(own))))[0]
    for number, each in enumerate(pairs.problems):
        own = np.flatnonzero(numbers == number)
        frame = each.frame.at[: len(own)].set(q[np.ix_(own, own)] @ each.frame[: len(own)])
        problems.append(eqx.tree_at(lambda p: p.frame, each, frame))
    return pairs.with_problems(problems), q


@pytest.mark.parametrize("way", ["landmarks", pytest.param("maps", marks=pytest.mark.slow)])
@pytest.mark.parametrize(
    "domain", ["square", *(pytest.param(name, marks=pytest.mark.slow) for name in ("sphere", "torus"))]
)
def test_alignment_undoes_a_rotation_and_changes_no_spectral_function(way, domain, rng):
    if domain == "square":
        pairs = square_pairs()
    elif domain == "torus":
        pairs = hj.eigenpairs(flat((6, 6), (1.0, 1.0), (True, True)), 13, "periodic", solver="dense", multiplet="drop")
    else:
        pairs = hj.eigenpairs(hj.examples.sphere_mesh(2), 13, solver="dense", multiplet="drop")
    moved, q = rotated(pairs, rng)
    shape = pairs.space.node_shape
    given = rng.standard_normal((9, *shape))
    if way == "landmarks":
        given = np.stack(np.unravel_index(rng.choice(np.prod(shape), 9, replace=False), shape), axis=-1)
        given = given[:, 0] if len(shape) == 1 else given
    found = hj.align(moved, pairs, (given, given))
    kept = np.asarray(pairs.kept)
    np.testing.assert_allclose(found.pairs.vectors[kept], pairs.vectors[kept], atol=1e-10)
    np.testing.assert_allclose((found.rotation @ q)[kept], np.eye(pairs.k)[kept], atol=1e-10)
    np.testing.assert_allclose(found.agreement[kept], 1)
    assert found.spread.max() < 1e-6
    assert found.pairs.converged.all()
    t = [0.05, 0.5]
    for values in (hj.hks, lambda p, t: hj.spectral_signature(p, lambda s, x: x * jnp.exp(-s * x), jnp.asarray(t))):
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", hj.AccuracyWarning)
            before, after = np.asarray(values(moved, t)), np.asarray(values(found.pairs, t))
        np.testing.assert_allclose(after, before, rtol=1e-12, atol=1e-12 * np.abs(before).max())


@pytest.mark.slow
def test_alignment_of_even_and_odd_modes_and_of_another_subject(rng):
    pairs = hj.eigenpairs(flat((7, 7), (1.0, 1.0)), 14, "mirror", solver="dense", multiplet="drop")
    moved, q = rotated(pairs, rng)
    nodes = np.stack(np.unravel_index(rng.choice(49, 12, replace=False), (7, 7)), axis=-1)
    found = hj.align(moved, pairs, (nodes, nodes))
    odd = np.isnan(found.agreement)
    np.testing.assert_allclose(found.rotation @ q, np.eye(14), atol=1e-10)
    assert not odd.any()
    # A subject whose metric differs a little splits the multiplets; a gap joins them.
    other = hj.TensorField(hj.Grid((8, 8), 1 / 7), np.eye(2) * (1 + 0.02 * rng.random((8, 8, 1, 1))))
    nearly, reference = hj.eigenpairs(other, 11, solver="dense"), square_pairs()
    maps = rng.standard_normal((20, 8, 8))
    only_signs = hj.align(nearly, reference, (maps, maps))
    joined = hj.align(nearly, reference, (maps, maps), gap=0.03)
    assert only_signs.spread.max() == 0
    assert 0 < joined.spread.max() < 0.03
    assert np.nanmin(joined.agreement) > 0.95
    assert np.nanmin(only_signs.agreement) < 0.95
    assert only_signs.pairs.converged.all()
    assert not joined.pairs.converged.all()
    before = np.asarray(hj.hks(nearly, [0.05], "raw"))
    after = np.asarray(hj.hks(joined.pairs, [0.05], "raw"))
    assert 0 < np.abs(after / before - 1).max() < 0.03


@pytest.mark.slow
@pytest.mark.parametrize("boundary", ["neumann", "mirror"])
def test_aligned_modes_have_derivatives_by_the_tensors(boundary, rng):
    """Each problem has simple eigenvalues, so the rotations are signs: the slope is that by differences."""
    field = flat((7, 6), (1.0, 1.3))
    reference = hj.eigenpairs(field, 5, boundary, solver="dense")
    change, weights = random_spd(rng, (7, 6), 0.5), rng.standard_normal((7, 6))
    nodes = np.array([[0, 0], [2, 3], [5, 1]])

    def value(tensors):
        pairs = hj.eigenpairs(hj.TensorField(field.grid, tensors), 5, boundary, solver="dense")
        aligned = hj.align(pairs, reference, (nodes, nodes)).pairs
        return jnp.sum(weights * (hj.hks(aligned, [0.6])[0] + hj.heat_kernel(aligned, [0.6], (1, 2))[0, 0]))

    slope = jnp.vdot(jax.grad(value)(field.tensors), change)
    np.testing.assert_allclose(slope, directional(value, field.tensors, change, 1e-3), rtol=1e-6)


def test_alignments_that_are_refused(rng):
    pairs = square_pairs()
    one = np.array([[3, 2]])
    with pytest.warns(hj.AccuracyWarning, match="correspondence: 1 landmarks or maps do not determine"):
        hj.align(pairs, pairs, (one, one))
    with pytest.raises(ValueError, match="correspondence: got 1 and 2 landmarks"):
        hj.align(pairs, pairs, (one, np.array([[3, 2], [1, 1]])))
    with pytest.raises(ValueError, match="correspondence: got no two arrays"):
        hj.align(pairs, pairs, one)
    with pytest.raises(ValueError, match="reference: got 4 pairs"):
        hj.align(pairs, hj.eigenpairs(pairs.pencil, 4, solver="dense"), (one, one))
    with pytest.raises(ValueError, match="pairs: got traced values"):
        jax.jit(lambda p: hj.align(p, pairs, (one, one)).rotation)(pairs)


def test_multiplets_are_numbered():
    pairs = square_pairs()
    values, labels = np.asarray(pairs.eigenvalues), np.asarray(pairs.multiplets)
    assert labels[0] == 0
    for i in range(1, pairs.k):
        assert (labels[i] != labels[i - 1]) == (values[i] - values[i - 1] > 1e-6 * values[i])
