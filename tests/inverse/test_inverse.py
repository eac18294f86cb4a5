"""Fits of metrics to signatures."""

import pickle
from dataclasses import replace

import jax
import jax.numpy as jnp
import numpy as np
import optimistix as optx
import pytest
from annotations import unchecked
from fields import random_spd, turning

import hks_jax as hj
from hks_jax.domain import spd
from hks_jax.inverse import (
    H1,
    Data,
    Free,
    LogDeterminant,
    Prior,
    Search,
    TotalVariation,
    identifiability,
    wave_kernel,
)
from hks_jax.inverse.observation import LOSSES, observe
from hks_jax.inverse.problem import Problem, more_pairs, outcome_of, truncation_shows
from hks_jax.inverse.signature import SIGNATURES, pairs_for
from hks_jax.inverse.unknowns import PARAMETRISATIONS, unknowns_for

N = 10
GRID = hj.Grid((N, N), 1 / (N - 1))
X, Y = GRID.nodes[..., 0], GRID.nodes[..., 1]
FLAT = hj.TensorField(GRID, np.broadcast_to(np.eye(2), (N, N, 2, 2)))
TIMES = np.geomspace(0.025, 0.3, 4)
K = N * N  # all of them: nothing is truncated
LOG_FACTOR = 0.4 * np.sin(2 * X) * np.cos(3 * Y)
CONFORMAL = hj.TensorField(GRID, np.exp(LOG_FACTOR)[..., None, None] * np.eye(2))


def smooth_field():
    a, b, c = 0.3 * np.sin(2 * X + Y), 0.3 * np.cos(3 * Y), 0.2 * np.sin(3 * X)
    return hj.TensorField(GRID, spd.exp(jnp.stack([jnp.stack([a, c], -1), jnp.stack([c, b], -1)], -2)))


def signature(field, k=K, times=TIMES):
    return np.asarray(hj.hks(hj.eigenpairs(field, k, multiplet="complete"), times))


def problem_of(target, times, init, k, weights=None):
    """The problem of a fit of conformal factors, without the fit."""
    space = hj.assemble(init).space
    unknowns = unknowns_for("conformal", init, space)
    observation, _ = observe(target, times, Data(weights=weights), space, np.float64)
    return Problem(unknowns, observation, (), k, "neumann", "dense")


def error(fit, truth):
    return np.linalg.norm(fit.field.tensors - truth.tensors) / np.linalg.norm(truth.tensors)


@pytest.mark.parametrize(
    ("name", "d"), [(n, 2 if n in ("log-euclidean", "conformal") else 3) for n in PARAMETRISATIONS]
)
def test_parametrisations_start_at_the_initial_field_and_stay_positive_definite(rng, name, d):
    base = jnp.asarray(random_spd(rng, (3,) * d).reshape(-1, d, d))
    parametrisation = PARAMETRISATIONS[name]
    start, tensors = parametrisation.start(base), jax.jit(lambda p, base: parametrisation.tensors(p, base))
    np.testing.assert_allclose(tensors(start, base), base, rtol=1e-12, atol=1e-12)
    moved = tensors(start + jnp.asarray(rng.standard_normal(start.shape)), base)
    assert spd.is_spd(np.asarray(moved)).all()
    kept = {"rotation": jnp.linalg.eigvalsh, "conformal": lambda t: t / spd.determinant(t)[:, None, None] ** (1 / d)}
    if name in kept:
        np.testing.assert_allclose(kept[name](moved), kept[name](base), rtol=1e-10, atol=1e-12)
    # Finite derivatives at the start, where base may be isotropic.
    isotropic = jnp.broadcast_to(jnp.eye(d), base.shape)
    slope = jax.jvp(lambda p: tensors(p, isotropic), (parametrisation.start(isotropic),), (start,))[1]
    assert jnp.isfinite(slope).all()


@pytest.mark.slow
def test_a_conformal_factor_is_recovered_from_a_flat_start():
    told = []
    fit = hj.fit_metric(FLAT, signature(CONFORMAL), TIMES, "conformal", k=K, progress=told.append)
    assert fit.converged
    assert fit.result == "converged"
    assert error(fit, CONFORMAL) < 1e-5
    assert told == list(fit.history)
    assert fit.history[-1].loss < 1e-6 * fit.history[0].loss
    np.testing.assert_allclose(fit.hks, signature(CONFORMAL), rtol=1e-5)
    np.testing.assert_allclose(fit.values[:, 0], LOG_FACTOR.ravel(), atol=1e-4)
    assert "converged" in repr(fit)


@pytest.mark.slow
def test_a_full_tensor_field_is_recovered():
    truth = smooth_field()
    fit = hj.fit_metric(FLAT, signature(truth), TIMES, k=K, search=Search(max_steps=7))
    assert error(fit, truth) < 0.03
    assert fit.loss < 1e-7 * fit.history[0].loss


@pytest.mark.slow
def test_by_default_k_is_enough_for_a_target_of_all_pairs():
    """The truth explains it; with fewer pairs it does not, and a fit from it goes away, to match its own truncation."""
    grid, times = hj.Grid((16, 14), (1 / 15, 1 / 13)), np.geomspace(0.02, 0.2, 4)
    log_factor = 0.4 * np.sin(2 * grid.nodes[..., 0]) * np.cos(3 * grid.nodes[..., 1])
    truth = hj.TensorField(grid, np.exp(log_factor)[..., None, None] * np.eye(2))
    flat = hj.TensorField(grid, np.broadcast_to(np.eye(2), (16, 14, 2, 2)))
    target, exact = signature(truth, 224, times), jnp.asarray(log_factor.reshape(-1, 1))
    chosen = pairs_for(times, hj.assemble(flat), flat)
    enough, few = (problem_of(target, times, flat, k) for k in (chosen, 35))
    assert chosen < 150
    # The residuals of a fit that stops at a relative change of 1e-4 in the unknowns.
    assert float(outcome_of(enough, exact).loss) < 0.01 * (1e-4) ** 2 / 2
    of_the_truth, _, left = map(float, outcome_of(few, exact)[:3])
    assert of_the_truth > (1e-4) ** 2 / 2
    assert 0.1 < left / of_the_truth < 10
    with pytest.warns(
        hj.AccuracyWarning,
        match=r"k: the truncation to 35 eigenpairs .* may compensate for the truncation.* Use k=None, or",
    ):
        poor = hj.fit_metric(truth, target, times, "conformal", k=35, search=Search(max_steps=2))
    assert poor.loss < 0.7 * of_the_truth
    assert error(poor, truth) > 1e-3
    fit = hj.fit_metric(flat, target, times, "conformal")
    assert fit.converged
    assert error(fit, truth) < 1e-5
    assert hj.truncation(fit.problem.pairs(fit.values), times).tail.max() < 2e-6
    assert fit.problem.k == chosen


def test_a_fit_may_begin_where_another_has_come_to():
    """At a metric of more volume, which takes more pairs than the first one was allowed."""
    grid, times = hj.Grid((15, 15), 1 / 14), np.array([0.006])
    flat, larger, largest = (hj.TensorField(grid, np.broadcast_to(c * np.eye(2), (15, 15, 2, 2))) for c in (1, 1.2, 3))
    assert pairs_for(times, hj.assemble(flat), flat) < 225
    with pytest.warns(
        hj.AccuracyWarning, match=r"which takes about 6\d eigenpairs, but with 225 unknowns only 56 are accurate"
    ):
        pairs_for(times, hj.assemble(larger), larger)
    with pytest.raises(ValueError, match=r"which takes about 1\d\d eigenpairs, .* Use times from about 0.01"):
        pairs_for(times, hj.assemble(largest), largest)


@pytest.mark.slow
def test_more_pairs_are_asked_for_where_the_volume_has_grown():
    """Three times the area of the start: the pairs that were enough there are not."""
    large = hj.TensorField(GRID, 3 * np.asarray(CONFORMAL.tensors))
    times = 3 * TIMES
    problem = problem_of(signature(large, times=times), times, FLAT, pairs_for(times, hj.assemble(FLAT), FLAT))
    values = jnp.asarray((LOG_FACTOR + np.log(3)).reshape(-1, 1))
    assert truncation_shows(*map(float, outcome_of(problem, values)[1:3]))
    assert more_pairs(problem, values) > 1.5 * problem.k


@pytest.mark.slow
def test_k_grows_with_the_volume_that_a_fit_comes_to():
    """Three times the area of the start: the pairs that were enough there are not."""
    large = hj.TensorField(GRID, 3 * np.asarray(CONFORMAL.tensors))
    times = 3 * TIMES
    fit = hj.fit_metric(FLAT, signature(large, times=times), times, "conformal", search=Search(max_steps=12))
    first = pairs_for(times, hj.assemble(FLAT), FLAT)
    assert fit.history[0].stage == 0
    assert fit.history[-1].stage == 1
    assert fit.problem.k > 1.5 * first
    assert fit.converged
    assert error(fit, large) < 1e-5


@pytest.mark.slow
def test_converged_means_the_unknowns():
    """A full field, whose weak directions short linear solves do not find: steps become small long before the end."""
    truth = smooth_field()
    fit = hj.fit_metric(FLAT, signature(truth), TIMES, search=Search(tolerance=1e-3, max_steps=20))
    exact = fit.problem.unknowns.parametrisation.start(truth.tensors.reshape(-1, 2, 2))
    deviation = float(jnp.sqrt(jnp.mean((fit.values - exact) ** 2)))
    assert fit.converged
    assert deviation < 3e-3


def test_targets_of_another_shape_or_without_their_zeros_are_refused():
    free, target = Free(lambda s: s * CONFORMAL.tensors, jnp.array(1.1)), signature(CONFORMAL)
    given = Data(signature=lambda pairs: hj.hks(pairs, TIMES))
    for other in (np.moveaxis(target, 0, -1), np.concatenate([target, target])):
        with pytest.raises(
            ValueError, match=r"target: got shape .* the signature of the fitted metric has the shape \(4, "
        ):
            hj.fit_metric(CONFORMAL, other, None, free, k=K, data=given)
    values = np.asarray(hj.eigenpairs(CONFORMAL, 8, multiplet="complete").eigenvalues)
    with pytest.raises(ValueError, match=r"1 of 7 observed values that are not zero, .* begins with 1 zeros"):
        hj.fit_metric(CONFORMAL, values[1:8], None, "conformal", data=Data("eigenvalues"))
    unobserved = np.append(values[:3], [np.nan, 1e9, *values[5:]])
    space = hj.assemble(CONFORMAL).space
    observed, _ = observe(unobserved, None, Data("eigenvalues", weights=unobserved < 1e8), space, np.float64)
    np.testing.assert_array_equal(observed.entries.value, np.delete(np.arange(values.size), [0, 3, 4]))
    with pytest.raises(ValueError, match=r"less than the value before .* Sort the eigenvalues"):
        hj.fit_metric(CONFORMAL, values[[0, 2, 1, 3]], None, "conformal", data=Data("eigenvalues"))


def test_a_fit_that_starts_at_the_solution_has_converged():
    fit = hj.fit_metric(CONFORMAL, signature(CONFORMAL), TIMES, "conformal", k=K)
    assert fit.result == "converged"
    assert len(fit.history) == 1
    # Residuals are not rounding errors because the unit of length makes them small.
    scale, search = 1e16, Search(max_steps=1)
    start, truth = (hj.TensorField(GRID, scale * np.asarray(field.tensors)) for field in (FLAT, CONFORMAL))
    target = signature(truth, times=scale * TIMES)
    fit = hj.fit_metric(start, target, scale * TIMES, "conformal", k=K, data=Data(loss="absolute"), search=search)
    assert fit.result == "steps exhausted"


@pytest.mark.slow
def test_noise_stops_the_fit_where_it_explains_the_misfit(rng):
    target = signature(CONFORMAL) * np.exp(0.01 * rng.standard_normal((4, N, N)))
    # 45 pairs leave out 0.1 %, which does not show beside the noise: no warning.
    fit = hj.fit_metric(FLAT, target, TIMES, "conformal", k=45, data=Data(noise=0.01))
    assert fit.result == "noise level reached"
    assert 0.5 * 0.01**2 * 0.3 < fit.misfit <= 0.5 * 0.01**2
    assert error(fit, CONFORMAL) < 0.03


@pytest.mark.slow
def test_rotations_with_fixed_eigenvalues():
    angle = 0.3 * np.sin(2 * X) + 0.2 * Y
    rotation = np.stack(
        [np.stack([np.cos(angle), -np.sin(angle)], -1), np.stack([np.sin(angle), np.cos(angle)], -1)], -2
    )
    values = np.diag([2.0, 0.8])
    init = hj.TensorField(GRID, np.broadcast_to(values, (N, N, 2, 2)))
    truth = hj.TensorField(GRID, rotation @ values @ np.swapaxes(rotation, -1, -2))
    fit = hj.fit_metric(init, signature(truth), TIMES, "rotation", k=K)
    assert error(fit, truth) < 0.02


@pytest.mark.slow
def test_a_model_that_cannot_explain_the_target_is_told(rng):
    """A conformal factor for a metric that is not conformal, with 1 % of noise."""
    grid, times = hj.Grid((6, 6), 0.2), TIMES[2:]
    flat, turned = (hj.TensorField(grid, np.broadcast_to(c, (6, 6, 2, 2))) for c in (np.eye(2), np.diag([1.0, 2.0])))
    target = signature(turned, 36, times) * np.exp(0.01 * rng.standard_normal((2, 6, 6)))
    with pytest.warns(
        hj.AccuracyWarning, match=r"noise: the fit ended \((converged|stalled)\) with residuals of 0\.0\d+, above"
    ):
        hj.fit_metric(flat, target, times, "conformal", k=36, data=Data(noise=0.01), search=Search(tolerance=0.05))


@pytest.mark.slow
def test_eigenvalues_alone():
    """From a start without symmetry: within a multiple eigenvalue only the sum of its copies has a derivative."""
    target = hj.eigenpairs(CONFORMAL, 30).eigenvalues
    init = hj.TensorField(GRID, np.exp(0.1 * X - 0.15 * Y)[..., None, None] * np.eye(2))
    fit = hj.fit_metric(
        init,
        target,
        None,
        "conformal",
        data=Data(signature="eigenvalues", loss="relative"),
        search=Search(smoothness=0.2, max_steps=12),
    )
    assert fit.misfit < 1e-8 * fit.history[0].misfit
    np.testing.assert_allclose(fit.hks, target, rtol=1e-3, atol=1e-9)


@pytest.mark.slow
def test_a_wave_kernel_signature():
    pairs = hj.eigenpairs(CONFORMAL, 30)
    energies, sigma = hj.default_energies(pairs, 30)
    target = hj.wks(pairs, energies, sigma)
    fit = hj.fit_metric(
        FLAT, target, energies, "conformal", k=30, data=Data(signature=wave_kernel(sigma)), search=Search(max_steps=8)
    )
    assert fit.loss < 1e-3 * fit.history[0].loss
    with pytest.raises(ValueError, match=r"times: got energies up to 9, which take about \d+ eigenpairs, but with 100"):
        hj.fit_metric(FLAT, target, np.linspace(3, 9, 30), "conformal", data=Data(signature=wave_kernel(sigma)))


@pytest.mark.slow
def test_unobserved_entries_have_no_influence(rng):
    weights = (rng.uniform(size=(N, N)) > 0.3).astype(float)
    target, values = signature(CONFORMAL), jnp.asarray(rng.normal(0, 0.1, (N * N, 1)))
    unknown = np.where(weights == 0, np.nan, target)
    problem = problem_of(unknown, TIMES, FLAT, K, weights)
    value, slope = jax.jit(jax.value_and_grad(lambda v: outcome_of(problem, v).loss))(values)
    observed = np.log(signature(hj.TensorField(GRID, np.exp(values.reshape(N, N, 1, 1)) * np.eye(2))) / target)
    mean = np.sum(weights * observed**2) / (4 * np.sum(weights))
    assert value == pytest.approx(mean / 2, rel=1e-9)
    assert jnp.isfinite(slope).all()


@pytest.mark.slow
def test_unobserved_entries_may_be_nan_and_do_not_count(rng):
    target = signature(CONFORMAL).copy()
    weights = (rng.uniform(size=(N, N)) > 0.3).astype(float)
    target[:, weights == 0] = np.nan
    fit = hj.fit_metric(FLAT, target, TIMES, "conformal", k=K, data=Data(weights=weights), search=Search(max_steps=6))
    assert error(fit, CONFORMAL) < 1e-2


@pytest.mark.slow
def test_gauss_newton_needs_fewer_signatures_than_lbfgs():
    target = signature(CONFORMAL)
    newton = hj.fit_metric(FLAT, target, TIMES, "conformal", k=K, search=Search(max_steps=4))
    lbfgs = hj.fit_metric(FLAT, target, TIMES, "conformal", k=K, search=Search(optimiser="lbfgs", max_steps=12))
    assert newton.loss < lbfgs.loss < lbfgs.history[0].loss
    assert all(np.isfinite(step.gradient) for step in (*newton.history, *lbfgs.history))


@pytest.mark.slow
def test_a_function_of_a_few_parameters():
    def bump(parameters):
        height = parameters["height"] * jnp.exp(-((X - parameters["x"]) ** 2 + (Y - 0.5) ** 2) / 0.1)
        return hj.TensorField(GRID, jnp.exp(height)[..., None, None] * jnp.eye(2))

    target = signature(bump({"height": 0.6, "x": 0.4}))
    start = {"height": 0.1, "x": 0.5}
    fit = hj.fit_metric(FLAT, target, TIMES, Free(bump, start), k=K)
    np.testing.assert_allclose(fit.values, [0.6, 0.4], atol=1e-4)
    with unchecked(), pytest.raises(ValueError, match=r"parametrisation: got <function .* or Free"):
        hj.fit_metric(FLAT, target, TIMES, bump, k=K)
    with pytest.raises(ValueError, match="regularisers: got a slope penalty, but the unknowns are parameters"):
        hj.fit_metric(FLAT, target, TIMES, Free(bump, start), k=K, regularisers=[H1(1.0)])


def test_penalties_are_means_over_the_domain():
    grid = hj.Grid((40, 60), (1 / 39, 2 / 59))
    x, y = grid.nodes[..., 0], grid.nodes[..., 1]
    flat = hj.TensorField(grid, np.broadcast_to(np.eye(2), (40, 60, 2, 2)))
    unknowns = unknowns_for("conformal", flat, hj.assemble(flat).space)
    values = jnp.asarray((3 * x + 2 * y).reshape(-1, 1))
    field = unknowns.field(values)

    def penalty(regulariser):
        return float(jnp.sum(regulariser.residuals(unknowns, values, field) ** 2) / 2)

    square = np.mean((3 * x + 2 * y) ** 2)
    # log T = p·I has the squared norm 2p², and log |T| = 2p.
    assert penalty(Prior(0.5, flat)) == pytest.approx(0.25 * 2 * square)
    assert penalty(LogDeterminant(0.5, flat)) == pytest.approx(0.25 * 4 * square)
    # A line of nodes has no edge beyond it.
    assert penalty(H1(0.5)) == pytest.approx(0.25 * 13, rel=0.03)
    assert penalty(TotalVariation(0.5, 0.01)) == pytest.approx(0.5 * np.sqrt(13), rel=0.03)
    assert all(penalty(each) == 0 for each in (Prior(1.0, field), LogDeterminant(1.0, field)))


@pytest.mark.parametrize("penalty", [H1(0.5), TotalVariation(0.5)])
def test_slopes_across_a_periodic_seam_count_as_all_others(penalty, rng):
    flat = hj.TensorField(hj.Grid((6, 5)), np.tile(np.eye(2), (6, 5, 1, 1)))
    values = rng.standard_normal((6, 5, 1))

    def size(values, boundary):
        unknowns = unknowns_for("conformal", flat, hj.assemble(flat, boundary).space)
        values = jnp.asarray(values.reshape(-1, 1))
        return jnp.sum(penalty.residuals(unknowns, values, unknowns.field(values)) ** 2)

    whole = size(values, ("periodic", "neumann"))
    np.testing.assert_allclose(size(np.roll(values, 2, axis=0), ("periodic", "neumann")), whole, rtol=1e-12)
    assert whole > size(values, "neumann")


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore:target. the fit ended:hks_jax.AccuracyWarning")  # the noise is not given
def test_a_regulariser_smooths_what_noise_roughens(rng):
    target = signature(CONFORMAL) * np.exp(0.05 * rng.standard_normal((4, N, N)))

    def roughness(*regularisers):
        fit = hj.fit_metric(
            FLAT, target, TIMES, "conformal", k=K, regularisers=regularisers, search=Search(max_steps=5)
        )
        assert fit.loss > fit.misfit or not regularisers
        return float(jnp.sum(jnp.diff(fit.values.reshape(N, N), axis=0) ** 2))

    assert roughness(H1(1e-4)) < 0.5 * roughness()


@pytest.mark.slow
def test_a_function_of_a_scalar_with_constants_of_its_own_is_fitted(tmp_path):
    target = signature(hj.TensorField(GRID, 1.2 * FLAT.tensors))
    fit = hj.fit_metric(GRID, target, TIMES, Free(lambda s: s * 1.5 * FLAT.tensors, jnp.array(0.6)), k=K)
    assert float(fit.values[0]) == pytest.approx(0.8, rel=1e-6)
    # Checkpoints tell functions apart by their tensors.
    options = {"k": K, "checkpoint": tmp_path / "fit.npz", "search": Search(max_steps=2)}
    first, second = (
        hj.TensorField.from_function(lambda x, level=level: level * jnp.eye(2) + 0 * x[0], GRID) for level in (1.0, 1.5)
    )
    hj.fit_metric(first, target, TIMES, "conformal", **options)
    with pytest.raises(ValueError, match="belongs to another fit"):
        hj.fit_metric(second, target, TIMES, "conformal", **options)


@pytest.mark.slow
def test_a_fit_knows_nodes_that_only_a_periodic_axis_joins():
    mask = np.zeros((12, 12), bool)
    mask[:6] = mask[11] = True
    field = hj.TensorField(hj.Grid((12, 12), 1 / 12, mask=mask), np.tile(np.eye(2), (12, 12, 1, 1)))
    boundary, times = ("periodic", "neumann"), [0.05, 0.1]
    target = hj.hks(hj.eigenpairs(field, 40, boundary), times)
    start = hj.TensorField(field.grid, 1.1 * field.tensors)
    fit = hj.fit_metric(start, target, times, "conformal", boundary=boundary)
    np.testing.assert_allclose(fit.field.tensors[mask], np.tile(np.eye(2), (mask.sum(), 1, 1)), atol=1e-5)


@pytest.mark.slow
def test_checkpoints_resume_where_a_fit_was_interrupted(tmp_path):
    target, file = signature(CONFORMAL), tmp_path / "deep" / "fit.npz"

    def interrupt(step):
        if step.step == 2:
            raise KeyboardInterrupt

    stopped = hj.fit_metric(FLAT, target, TIMES, "conformal", k=K, progress=interrupt)
    assert stopped.result == "interrupted"
    assert not stopped.converged
    assert stopped.loss < 1e-2 * stopped.history[0].loss
    first = hj.fit_metric(FLAT, target, TIMES, "conformal", k=K, checkpoint=file, search=Search(max_steps=2))
    assert first.result == "steps exhausted"
    again = hj.fit_metric(FLAT, target, TIMES, "conformal", k=K, checkpoint=file)
    assert again.converged
    assert again.history[:3] == first.history
    assert [path.name for path in file.parent.iterdir()] == ["fit.npz"]
    with pytest.raises(ValueError, match=r"checkpoint: .* belongs to another fit"):
        hj.fit_metric(FLAT, 2 * target, TIMES, "conformal", k=K, checkpoint=file)
    (tmp_path / "notes.txt").write_text("no checkpoint")
    with pytest.raises(ValueError, match=r"checkpoint: .*notes.txt: the file is damaged or not a readable npz archive"):
        hj.fit_metric(FLAT, target, TIMES, "conformal", k=K, checkpoint=tmp_path / "notes.txt")


@pytest.mark.parametrize("penalty", [LogDeterminant, Prior])
def test_only_nodes_inside_the_mask_count_in_a_penalty(penalty):
    mask = np.ones((5, 5), bool)
    mask[:2, :2] = False
    whole = hj.TensorField(hj.Grid((5, 5)), np.tile(3 * np.eye(2), (5, 5, 1, 1)))
    field = hj.TensorField(hj.Grid((5, 5), mask=mask), np.tile(np.eye(2), (5, 5, 1, 1)))
    unknowns = unknowns_for("conformal", field, hj.assemble(field).space)
    residuals = penalty(2.0, whole).residuals(unknowns, unknowns.start(), field)
    factor = 4 if penalty is LogDeterminant else 2
    np.testing.assert_allclose(jnp.sum(residuals**2) / 2, factor * np.log(3) ** 2, rtol=1e-12)
    unknowns = unknowns_for("conformal", whole, hj.assemble(whole).space)
    with pytest.raises(ValueError, match=r"prior: got a field on Grid\(.*21 of 25 nodes\); expected tensors at all"):
        penalty(2.0, field).residuals(unknowns, unknowns.start(), whole)


@pytest.mark.slow
def test_a_search_from_several_starts_keeps_its_best_fit_and_how_it_ended(tmp_path):
    grid = hj.Grid((5, 5), 0.25)
    flat = hj.TensorField(grid, np.tile(np.eye(2), (5, 5, 1, 1)))
    target = 1.3**-1 * np.asarray(hj.eigenpairs(flat, 4).eigenvalues)
    data, search = Data(signature="eigenvalues"), Search(starts=3, spread=0.2, seed=0, max_steps=8)

    def scaled(s):  # the initial guesses are 1, 0.8 and 1.2
        return jnp.where(s > 0.95, s, jnp.nan) * jnp.tile(jnp.eye(2), (5, 5, 1, 1))

    def fit(init=flat, **options):
        options = {"data": data, "search": search, "checkpoint": tmp_path / "fit.npz"} | options
        return hj.fit_metric(init, target, None, Free(scaled, 1), **options)

    def interrupt(step):
        if step.start == 2 and step.step == 1:
            raise KeyboardInterrupt

    prior = LogDeterminant(1e-9, flat)
    stopped = fit(progress=interrupt, regularisers=[prior])
    assert np.isnan(stopped.losses[1])
    assert stopped.result == "interrupted"
    again = fit(regularisers=[prior])
    assert again.converged
    assert again.loss == np.nanmin(again.losses)
    np.testing.assert_allclose(again.values, 1.3, rtol=1e-4)
    gradient = jax.grad(lambda v: sum(jnp.sum(r**2) for r in again.problem.residuals(v)) / 2)(jnp.array([1.0]))
    np.testing.assert_allclose(again.history[0].gradient, jnp.linalg.norm(gradient), rtol=1e-6)
    wider = hj.TensorField(hj.Grid((5, 5), 0.5), flat.tensors)
    for other in ({"regularisers": [Prior(1e-9, flat)]}, {"regularisers": [prior], "init": wider}):
        with pytest.raises(ValueError, match="belongs to another fit"):
            fit(**other)


@pytest.mark.slow
def test_continuation_and_several_starts():
    fit = hj.fit_metric(
        FLAT, signature(CONFORMAL), TIMES, "conformal", search=Search(continuation=2, starts=2, max_steps=2, seed=3)
    )
    assert [(step.start, step.stage) for step in fit.history[::3]] == [(0, 0), (0, 1), (1, 0), (1, 1)]
    assert fit.loss == min(fit.losses)
    assert len(fit.losses) == 2
    # Two times of four need fewer eigenpairs.
    assert fit.history[0].loss != fit.history[3].loss


@pytest.mark.slow
def test_deviation_bounds_that_of_the_exact_posterior():
    """Under the white prior the posterior's covariance is (JᵀJ/σ² + 1/τ²)⁻¹."""
    grid = hj.Grid((7, 6), 0.2)
    tensors = np.exp(0.3 * np.sin(3 * grid.nodes[..., 0]))[..., None, None] * np.eye(2)
    target = hj.hks(hj.eigenpairs(hj.TensorField(grid, tensors), 42), [0.15, 0.4])
    init = hj.TensorField(grid, np.broadcast_to(np.eye(2), (7, 6, 2, 2)))
    problem = problem_of(target, [0.15, 0.4], init, 42)
    values = jnp.asarray(0.2 * np.sin(3 * grid.nodes[..., 0]).reshape(-1, 1))
    jacobian = jax.jit(jax.jacfwd(lambda v: problem.observation.residuals(problem.pairs(v))))(values)[..., 0]
    variance = 0.02**2 / target.size
    exact = np.sqrt(np.diag(np.linalg.inv(jacobian.T @ jacobian / variance + np.eye(42) / 0.5**2)))
    few, many = (identifiability(problem, values, n=n, n_weak=1, noise=0.02, prior=0.5, iterations=20) for n in (6, 42))
    assert (few.deviation >= exact * (1 - 1e-6)).all()
    np.testing.assert_allclose(many.deviation, exact, rtol=1e-5)
    assert (few.deviation > 1.1 * exact).mean() > 0.5
    assert (few.deviation < 0.5).all()


def test_entries_that_no_metric_changes_do_not_count_in_the_noise():
    """Signatures at Dirichlet nodes and the eigenvalues of null vectors are zero for every metric."""
    field = hj.TensorField(hj.Grid((6, 6), 0.2), np.tile(np.eye(2), (6, 6, 1, 1)))
    zero, free = hj.eigenpairs(field, 16, "dirichlet"), hj.eigenpairs(field, 4)
    for pairs, target, times, kind in (
        (zero, hj.hks(zero, [0.05, 0.1]), [0.05, 0.1], "hks"),
        (free, free.eigenvalues, None, "eigenvalues"),
    ):
        observation, noise = observe(target, times, Data(kind, deviation=0.02), pairs.space, float)
        positive = np.asarray(target)[np.asarray(target) > 0]
        assert noise == pytest.approx(np.mean((positive / 0.02) ** 2) ** -0.5)
        np.testing.assert_allclose(observation.root_weights, positive / np.linalg.norm(positive))


@pytest.mark.slow
def test_error_bars_of_a_fit_are_those_of_its_posterior():
    """The covariance is (JᵀΣ⁻¹J + R)⁻¹, with the penalties' and the white prior's R."""
    grid = hj.Grid((7, 6), 0.2)
    tensors = np.exp(0.3 * np.sin(3 * grid.nodes[..., 0]))[..., None, None] * np.eye(2)
    target = hj.hks(hj.eigenpairs(hj.TensorField(grid, tensors), 42), [0.15, 0.4])
    init = hj.TensorField(grid, np.broadcast_to(np.eye(2), (7, 6, 2, 2)))
    deviation = 0.02 * target * (1 + np.arange(6) / 3)
    fit = hj.fit_metric(
        init,
        target,
        [0.15, 0.4],
        "conformal",
        k=42,
        regularisers=[H1(1e-5)],
        data=Data(deviation=deviation),
        search=Search(max_steps=3),
    )
    relative = np.asarray(deviation / target)
    assert fit.noise == pytest.approx(np.sqrt(target.size / np.sum(relative**-2.0)))

    def residuals(values):
        _, penalties = fit.problem.residuals(values)
        signature = fit.problem.observation.predict(fit.problem.pairs(values))
        own = jnp.log(signature / target) / relative
        return jnp.concatenate([own.ravel(), penalties * np.sqrt(target.size) / fit.noise])

    A = jax.jit(jax.jacfwd(residuals))(fit.values)[..., 0]
    exact = np.sqrt(np.diag(np.linalg.inv(A.T @ A + np.eye(42) / 0.5**2)))
    found = fit.uncertainty(prior=0.5, draws=400)
    assert found.unsolved < 1e-5
    ratio = np.asarray(found.values)[:, 0] / exact
    assert abs(ratio.mean() - 1) < 0.02
    assert ratio.std() < 2 * found.sampling_error
    # T = e^u I.
    np.testing.assert_allclose(
        found.tensors[..., 0, 0].ravel(), np.exp(fit.values[:, 0]) * found.values[:, 0], rtol=1e-10
    )
    with pytest.raises(
        ValueError, match=r"deviation: got 14 of 84 .* not positive numbers \(the first is 0 at \(0, 0, 1\)"
    ):
        hj.fit_metric(
            init, target, [0.15, 0.4], data=Data(deviation=np.where(np.arange(6) % 7 == 1, 0, 0.1)[: target.shape[-1]])
        )
    with pytest.raises(ValueError, match="deviation: got a value with a function as loss"):
        hj.fit_metric(init, target, [0.15, 0.4], data=Data(deviation=deviation, loss=lambda a, b: a - b))


@pytest.mark.slow
def test_identifiability_is_the_spectrum_of_the_information():
    fit = hj.fit_metric(FLAT, signature(CONFORMAL), TIMES, "conformal", k=K, search=Search(max_steps=2))
    problem = fit.problem
    report = identifiability(fit, n=12, n_weak=2, iterations=12)
    jacobian = jax.jit(jax.jacfwd(lambda v: problem.observation.residuals(problem.pairs(v))))(fit.values)
    information = np.asarray(jacobian.reshape(len(jacobian), -1))
    exact = np.linalg.eigvalsh(information.T @ information)
    np.testing.assert_allclose(report.strengths[:8], exact[::-1][:8], rtol=0.02)
    assert exact[0] * (1 - 1e-9) <= report.weak_strengths[0] < 1.5 * exact[0]
    assert ((report.resolution >= 0) & (report.resolution <= 1)).all()
    assert 0 < report.effective <= 12
    assert (report.deviation <= 1).all()
    # Fewer times, less information; weights that are nearly zero leave times out without another compilation.
    fewer = Data(weights=np.repeat([1e-30, 1.0], 2 * K).reshape(4, N, N))
    observation, _ = observe(signature(CONFORMAL), TIMES, fewer, hj.assemble(FLAT).space, np.float64)
    poorer = identifiability(replace(problem, observation=observation), fit.values, n=12, n_weak=2, iterations=12)
    assert poorer.strengths[11] < report.strengths[11]


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"target": lambda t: t[:, 1:]}, r"target: got shape \(4, 9, 10\); expected .* \(4, 10, 10\)"),
        ({"target": lambda t: np.where(t == t[0, 0, 0], np.nan, t)}, "target: got 1 of 400 observed .* are NaN"),
        ({"target": lambda t: t - 100}, r"target: got \d+ of 400 .* not positive \(the first is .* at \(0, 0, "),
        ({"times": [0.1, -1.0, 1.0, 2.0]}, "times: got -1.0; expected positive"),
        ({"times": np.array([1e-5, 0.1, 0.2, 0.3])}, "times: got 1e-05, which takes about .* Use times from about"),
        ({"parametrisation": "spherical"}, "parametrisation: got 'spherical'; expected 'log-euclidean'"),
        ({"data": {"signature": "sound"}}, "signature: got 'sound'; expected 'hks'"),
        ({"data": {"loss": "gain"}}, "loss: got 'gain'; expected 'log'"),
        ({"search": {"optimiser": "sgd"}}, "optimiser: got 'sgd'; expected 'gauss-newton'"),
        ({"data": {"weights": np.zeros((N, N))}}, "weights: got only zeros"),
        ({"data": {"weights": np.ones(3)}}, r"weights: got shape \(3,\); expected a shape that broadcasts"),
        ({"data": {"noise": -1}}, "noise: got -1; expected a finite number above 0"),
        ({"search": {"max_steps": 0}}, "max_steps: got 0; expected an integer of at least 1"),
        ({"search": {"smoothness": -1.0}}, "smoothness: got -1.0; expected a finite number from 0"),
        ({"data": {"signature": "wks"}}, "signature: got 'wks'; .* wave_kernel"),
        ({"data": {"signature": lambda pairs: pairs.eigenvalues}, "target": lambda t: t[0, 0]}, "k: got None"),
        ({"data": {"signature": wave_kernel(0.5)}, "times": None}, "times: got None; expected energies"),
    ],
)
def test_bad_arguments_are_named(changes, message):
    target = np.linspace(1, 2, 4 * N * N).reshape(4, N, N)
    target = changes.get("target", lambda t: t)(target)

    def fit():
        settings = {"data": Data(**changes.get("data", {})), "search": Search(**changes.get("search", {}))}
        return hj.fit_metric(FLAT, **{"times": TIMES} | changes | {"target": target} | settings)

    with unchecked(), pytest.raises(ValueError, match=message):
        fit()


def test_an_array_is_no_place_to_start():
    with unchecked(), pytest.raises(TypeError, match=r"init: got ndarray; expected hks_jax\.Grid or hks_jax\.Tensor"):
        hj.fit_metric(np.ones((4, N, N)), TIMES, FLAT)
    with (
        unchecked(),
        pytest.raises(TypeError, match=r"regularisers: got one H1; expected a list of penalties"),
    ):
        hj.fit_metric(FLAT, np.ones((4, N, N)), TIMES, regularisers=H1(1e-3))


def test_solvers_of_optimistix_are_taken_as_they_are():
    solver = optx.BFGS(1e-3, 1e-3)
    target = hj.heat_trace(hj.eigenpairs(CONFORMAL, K), TIMES)
    fit = hj.fit_metric(
        GRID,
        target,
        TIMES,
        "conformal",
        k=K,
        data=Data(signature="heat-trace"),
        search=Search(optimiser=solver, tolerance=1e-2, max_steps=12),
    )
    assert float(outcome_of(fit.problem, fit.values).loss) == pytest.approx(fit.loss)
    assert fit.loss < 0.1 * fit.history[0].loss
    # Each point that the solver came to is told once, the last one too, with the loss that belongs to it.
    assert [step.step for step in fit.history] == list(range(len(fit.history)))
    assert len({step.loss for step in fit.history}) == len(fit.history)
    assert min(step.loss for step in fit.history) == pytest.approx(fit.loss, rel=1e-12)


def test_fits_can_be_pickled_with_every_named_setting():
    problem = problem_of(signature(FLAT), TIMES, FLAT, K)
    settings = LOSSES, SIGNATURES, PARAMETRISATIONS, problem
    again = pickle.loads(pickle.dumps(settings))
    assert [list(table) for table in again[:3]] == [list(table) for table in settings[:3]]
    assert again[0]["relative"](jnp.array(3.0), jnp.array(2.0)) == 0.5
    assert again[2]["rotation"].start(jnp.ones((5, 3, 3))).shape == (5, 3)


def _full(grid):
    """A metric with a shear, which no conformal factor explains."""
    return hj.TensorField(grid, turning(grid.nodes, 2.0, 0.7))


@pytest.mark.slow
@pytest.mark.parametrize(("parametrisation", "finer"), [("conformal", 1), ("log-euclidean", 2)])
def test_a_target_that_the_metric_does_not_explain_is_told_without_noise(parametrisation, finer):
    grids = [hj.Grid.from_bounds(0, 1, (n, n)) for n in (8, 7 * finer + 1)]
    times = np.array([0.05, 0.2])
    pairs = hj.eigenpairs(_full(grids[1]), 40, solver="dense")
    target = hj.hks(pairs, times)[:, ::finer, ::finer]
    search = hj.inverse.Search(max_steps=4)
    with pytest.warns(
        hj.AccuracyWarning, match=r"target: the fit ended .* with residuals of .* pass its error as noise"
    ):
        hj.fit_metric(grids[0], target, times, parametrisation, k=40, search=search)


def test_a_mesh_is_refused_with_what_to_do_instead():
    mesh = hj.SurfaceMesh(np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0]]), np.array([[0, 1, 2]]))
    with unchecked(), pytest.raises(TypeError, match=r"init: got SurfaceMesh; .* on grids only\. .*value_and_grad"):
        hj.fit_metric(mesh, np.ones((1, 3)), [0.1])
