"""Batches whose problems are solved one after another."""

import jax
import jax.numpy as jnp
import numpy as np

from hks_jax.linear.loops import one_by_one


def halvings(most, x, unit):
    """Halve x["value"] until it is below the unit; return how often that was, at most so many times, and the end."""
    state = jax.lax.while_loop(
        lambda state: (state[1] >= unit) & (state[0] < most),
        lambda state: (state[0] + 1, state[1] / 2),
        (0, x["value"]),
    )
    return state[0], jnp.stack([state[1], unit])


def run(values, unit):
    return one_by_one(halvings, (6,), {"value": values}, unit)


VALUES, UNITS = np.array([[0.5, 1.0, 5.0], [9.0, 100.0, 1e9]]), np.array([1.0, 2.0])
TIMES = np.array([[0, 1, 3], [4, 6, 6]])
TIMES_OF_TWO = np.array([[0, 0, 2], [3, 6, 6]])


def test_a_batch_is_the_loop_of_its_problems():
    times, ends = jax.vmap(run, (0, None))(jnp.asarray(VALUES[1]), jnp.asarray(1.0))
    np.testing.assert_array_equal(times, TIMES[1])
    np.testing.assert_array_equal(ends, np.stack([VALUES[1] / 2.0**times, np.ones(3)], axis=1))


def test_a_batch_of_batches_with_what_some_share():
    batch = jax.jit(jax.vmap(jax.vmap(run, (0, None)), (None, 0), out_axes=1))
    for values, columns in ((VALUES[0], 0), (VALUES[1], 1)):
        times, ends = batch(jnp.asarray(values), jnp.asarray(UNITS))
        np.testing.assert_array_equal(times, np.stack([TIMES[columns], TIMES_OF_TWO[columns]], axis=1))
        assert ends.shape == (3, 2, 2)


def test_on_a_cpu_it_is_a_loop_and_elsewhere_one_computation():
    batch = jax.jit(jax.vmap(run, (0, None)))
    args = jnp.asarray(VALUES[0]), jnp.asarray(1.0)
    loops = {
        platform: batch.trace(*args).lower(lowering_platforms=(platform,)).as_text() for platform in ("cpu", "cuda")
    }
    assert loops["cpu"].count("stablehlo.while") == 2  # over problems, and of each
    assert loops["cuda"].count("stablehlo.while") == 1


def test_plain_values_are_not_traced():
    seen = []
    one_by_one(lambda x: seen.append(isinstance(x, jax.core.Tracer)), (), jnp.ones(3))
    assert seen == [False]
