"""Functions compiled quickly do what `jax.jit` does, wherever they are called."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from hks_jax import compilation
from hks_jax.compilation import jit_quickly


def make_power():
    @jit_quickly(static_argnames="exponent")
    def power(x, exponent):
        """Return a power."""
        return x**exponent

    return power


@pytest.mark.parametrize(
    "use",
    [
        lambda power: power(3.0, exponent=2),
        lambda power: jax.jit(lambda x: power(x, 2))(3.0),
        lambda power: jax.jit(lambda x: power(3.0, 2) + 0 * x)(1.0),  # a constant within another computation
        lambda power: jax.vmap(lambda x: power(x, 2))(jnp.asarray([3.0]))[0],
        lambda power: jax.grad(lambda x: power(x, 3))(3.0) / 3,
        lambda power: jax.jvp(lambda x: power(x, 2), (3.0,), (0.0,))[0],
        lambda power: jax.lax.map(lambda x: power(x, 2), jnp.asarray([3.0]))[0],
    ],
)
def test_it_can_be_called_alone_and_within_transformations(use):
    assert use(make_power()) == 9


def test_where_the_compiler_does_not_know_the_options_it_does_without(monkeypatch):
    monkeypatch.setattr(compilation, "_OPTIONS", {"xla_of_another_time": True})
    compilation._understood.cache_clear()
    try:
        power = make_power()
        np.testing.assert_array_equal(power(jnp.arange(3.0), 2), [0, 1, 4])
        assert not compilation._understood()
    finally:
        compilation._understood.cache_clear()


def test_options_that_the_environment_sets_are_left_alone(monkeypatch):
    for flags, ours in [("--xla_backend_optimization_level=0", False), ("--xla_unrelated=1", True), ("", True)]:
        monkeypatch.setenv("XLA_FLAGS", flags)
        compilation._understood.cache_clear()
        assert compilation._understood() == ours
    compilation._understood.cache_clear()


def test_the_function_keeps_its_name_and_words():
    power = make_power()
    assert (power.__name__, power.__doc__) == ("power", "Return a power.")
