"""Counts of eigenvalues at nasty shifts, against a dense spectrum.

Shifts are eigenvalues of parts of the domain, at which an elimination without pivoting breaks down; numbers very near
to eigenvalues; and any numbers. A count must be right or refused. Where it is refused although no eigenvalue is near,
it is refused for nothing, which is a failure too.
"""

from functools import cache

import jax
import jax.numpy as jnp
import numpy as np
import scipy.linalg

import hks_jax as hj
from hks_jax.fem.pencil import Pencil
from hks_jax.linear.dissection import Dissection, dissect

from .harness import Outcome
from .problems import DOMAINS, Problem, random_problem

UNREFLECTED = tuple(domain for domain in DOMAINS if "mirror" not in domain.boundary)
_NEAR = 1e-6
"""Relative to λ_max, how near to an eigenvalue a count may be refused."""


def check(seed: int) -> Outcome:
    """Count at one shift of a random problem."""
    rng = np.random.default_rng(seed)
    problem, pencil, spectrum, of_parts = _problem(seed // 20)
    kind = rng.integers(3)
    if kind == 0 and of_parts.size:
        shift = rng.choice(of_parts)
    elif kind == 1:
        shift = rng.choice(spectrum) + rng.choice([-1, 1]) * 10.0 ** rng.uniform(-16, -2) * spectrum[-1]
    else:
        shift = rng.uniform(-0.1, 1.1) * spectrum[-1]
    true, distance = int(np.sum(spectrum < shift)), np.min(np.abs(spectrum - shift)) / spectrum[-1]
    traced = int(_count(pencil, jnp.asarray(shift)))
    assert traced in (true, -1) or distance < 1e-13, f"{problem}: {traced} below {shift!r} under jit, {true} are"
    try:
        count = int(hj.count_eigenvalues(pencil, shift))
    except ValueError as error:
        if not str(error).startswith("below: ") or distance >= _NEAR:
            raise AssertionError(f"{problem}: refused {shift!r}, {distance:.1e} λ_max from an eigenvalue") from error
        return "refused"
    assert count == true or distance < 1e-13, f"{problem}: {count} below {shift!r}, {true} are"
    return "right"


_count = jax.jit(hj.count_eigenvalues)


@cache
def _problem(seed: int) -> tuple[Problem, Pencil, np.ndarray, np.ndarray]:
    """Return a problem, its pencil, its spectrum, and eigenvalues of parts of its domain."""
    problem = random_problem(seed, UNREFLECTED)
    pencil = problem.pencil()
    assert isinstance(pencil, Pencil)
    K, M = np.asarray(pencil.stiffness.to_dense()), np.asarray(pencil.mass.to_dense())
    dissection = dissect(pencil.pattern)
    parts = [
        scipy.linalg.eigh(K[np.ix_(nodes, nodes)], M[np.ix_(nodes, nodes)], eigvals_only=True)
        for level in range(1, len(dissection.levels))
        for front in range(len(dissection.levels[level].own))
        if (nodes := _subtree(dissection, level, front)).size
    ]
    return problem, pencil, scipy.linalg.eigh(K, M, eigvals_only=True), np.concatenate([*parts, np.empty(0)])


def _subtree(dissection: Dissection, level: int, front: int) -> np.ndarray:
    """Return the degrees of freedom that a front and those below it eliminate."""
    own = [
        fronts.own[front << depth : (front + 1) << depth].ravel()
        for depth, fronts in enumerate(dissection.levels[level:])
    ]
    nodes = np.concatenate(own)
    return nodes[nodes < dissection.order.size]
