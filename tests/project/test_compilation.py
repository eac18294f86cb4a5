"""Functions compiled quickly do what `jax.jit` does, wherever they are called."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import hks_jax as hj
from hks_jax import compilation
from hks_jax.compilation import jit_quickly


@pytest.fixture
def flags(monkeypatch):
    """Return a function that sets XLA_FLAGS and forgets the compiler's earlier answer."""

    def set_flags(value):
        monkeypatch.setenv("XLA_FLAGS", value)
        compilation._understood.cache_clear()

    yield set_flags
    compilation._understood.cache_clear()


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


def test_where_the_compiler_does_not_know_the_options_it_does_without(flags, monkeypatch):
    monkeypatch.setattr(compilation, "_OPTIONS", {"xla_of_another_time": True})
    flags("")
    power = make_power()
    np.testing.assert_array_equal(power(jnp.arange(3.0), 2), [0, 1, 4])
    assert not compilation._understood()
    assert hj.compiler_options() == {}


def test_options_that_the_environment_sets_are_left_alone(flags):
    for given, ours in [("--xla_backend_optimization_level=0", False), ("--xla_unrelated=1", True), ("", True)]:
        flags(given)
        assert compilation._understood() == bool(hj.compiler_options()) == ours


@pytest.mark.slow
def test_public_options_change_no_value_and_no_gradient(flags):
    flags("")
    options = hj.compiler_options()
    field = hj.examples.sphere_field(9, 1.0)

    def total(tensors):
        pairs = hj.eigenpairs(hj.TensorField(field.grid, tensors), k=12, multiplet="drop")
        return jnp.sum(hj.hks(pairs, [0.1, 0.3]))

    function = jax.value_and_grad(total)
    fast, usual = (jax.jit(function, compiler_options=each)(field.tensors) for each in (options, {}))
    assert set(options) == set(compilation._OPTIONS)
    np.testing.assert_allclose(fast[0], usual[0], rtol=1e-12)
    np.testing.assert_allclose(fast[1], usual[1], rtol=0, atol=1e-10 * np.abs(usual[1]).max())
    assert options is not hj.compiler_options()  # a change of the dictionary changes no other caller's


def test_an_accelerator_has_no_options(flags, monkeypatch):
    flags("")
    monkeypatch.setattr(jax, "default_backend", lambda: "gpu")
    assert hj.compiler_options() == {}


@pytest.mark.parametrize("use", [jax.grad, jax.jit])
def test_options_belong_to_the_outermost_function(flags, use):
    flags("")
    compiled = jax.jit(jnp.sin, compiler_options=hj.compiler_options())
    with pytest.raises(ValueError, match="top-level"):
        use(compiled)(1.0)


def test_the_function_keeps_its_name_and_words():
    power = make_power()
    assert (power.__name__, power.__doc__) == ("power", "Return a power.")
