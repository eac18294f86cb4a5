"""No program stops for ever: linear algebra beside other linear algebra, compiled as users have it."""

import re
from pathlib import Path

import pytest
from concurrent_programs import PROGRAMS, run

PACKAGE = Path(__file__).parents[2] / "hks_jax"


OF_TWO = [
    *("count, mirror and neumann", "gradient, mean", "two eigenpairs", "two eigsh", "two matrix functions"),
    *("spectrum-free", "logarithms", "beside a user's batch"),
]
OF_FOUR = [name for name in PROGRAMS if name not in (*OF_TWO, "fit")]
NAMES = [*OF_FOUR, *OF_TWO]


# Several programs in each process, as a process takes longer to start than most of them. Threads stop for ever when all
# of them wait, so that what stops four stops two sooner: four have only those with most problems beside each other.
@pytest.mark.slow
@pytest.mark.parametrize(
    ("threads", "programs"),
    [
        *((threads, NAMES[start::3]) for threads in (1, 2) for start in range(3)),
        *((4, OF_FOUR[start::2]) for start in range(2)),
    ],
    ids=lambda value: "; ".join(value) if isinstance(value, list) else None,
)
def test_programs_end(programs, threads):
    run(programs, threads=threads, limit=900)


@pytest.mark.slow
def test_devices_of_one_cpu_do_not_wait_for_each_other():
    run(["gradients on devices"], devices=2)


@pytest.mark.slow
@pytest.mark.parametrize("threads", [1, 2])
def test_a_fit_ends(threads):
    run(["fit"], calls=4, threads=threads)


def test_nothing_else_calls_lapack():
    call = re.compile(
        r"(?<!np\.)linalg\.(cholesky|eig\w*|inv|lu\w*|pinv|qr|slogdet|solve\w*|svd\w*|triangular_solve)\("
    )
    files = [path for path in PACKAGE.rglob("*.py") if path.name != "lapack.py"]
    assert [path.name for path in files if call.search(path.read_text().replace("jnp.", "jax.numpy."))] == []
