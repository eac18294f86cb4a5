"""Random domains and metrics: few shapes, so that much is compiled once; many fields, ugly and symmetric ones too."""

from dataclasses import dataclass
from functools import cache

import jax.numpy as jnp
import numpy as np

import hks_jax as hj
from hks_jax.fem.pencil import MirrorPencil, Pencil

from .own_assembly import Form


@dataclass(frozen=True)
class Domain:
    """A domain and its boundary conditions."""

    shape: tuple[int, ...]
    spacing: tuple[float, ...]
    boundary: str | tuple = "neumann"
    mass: str = "consistent"
    mask: str = ""


DOMAINS = (
    Domain((16, 16), (0.1, 0.1)),
    Domain((20, 17), (0.1, 0.2), "dirichlet", "lumped"),
    Domain((18, 16), (1e-3, 1e-3), "periodic"),
    Domain((22, 15), (1.0, 1.0), ("periodic", "neumann"), "lumped"),
    Domain((24, 21), (0.1, 0.1), (("neumann", "dirichlet"), "neumann")),
    Domain((3, 97), (0.0167, 0.808)),
    Domain((4, 90), (1.0, 1.0), "neumann", "lumped"),
    Domain((30, 26), (0.1, 0.1), mask="disc"),
    Domain((33, 20), (0.1, 0.1), mask="dumbbell"),
    Domain((24, 24), (0.1, 0.1), mask="islands"),
    Domain((7, 6, 8), (0.1, 0.1, 0.1)),
    Domain((6, 7, 6), (0.1, 0.2, 0.1), ("periodic", "dirichlet", "neumann"), "lumped"),
    Domain((8, 8, 8), (1.0, 1.0, 1.0), mask="disc"),
    Domain((14, 13), (0.1, 0.1), "mirror"),
    Domain((8, 7, 6), (0.1, 0.1, 0.1), (("neumann", "dirichlet"), "mirror", "neumann")),
)

FIELDS = ("smooth", "rough", "flat", "nearly flat", "turning", "jumps", "anisotropic")


@dataclass(frozen=True)
class Problem:
    """A tensor field with boundary conditions and mass."""

    seed: int
    kind: str
    domain: Domain
    field: hj.TensorField

    def pencil(self) -> Pencil | MirrorPencil:
        """Assemble it."""
        return hj.assemble(self.field, self.domain.boundary, self.domain.mass)

    def __str__(self) -> str:
        return f"{self.kind} field {self.seed} on {self.domain}"


def random_problem(seed: int, domains: tuple[Domain, ...] = DOMAINS) -> Problem:
    """Return one of the domains with a random field."""
    rng = np.random.default_rng(seed)
    domain = domains[rng.integers(len(domains))]
    kind = FIELDS[rng.integers(len(FIELDS))]
    mask = _mask(domain)
    grid = hj.Grid(domain.shape, domain.spacing, mask=mask, components="all")
    tensors = _tensors(kind, rng, domain.shape) * 10.0 ** rng.choice([0, 0, 0, -6, 6])
    return Problem(seed, kind, domain, hj.TensorField(grid, jnp.asarray(tensors)))


def random_form(rng: np.random.Generator, domain: Domain, tensors: np.ndarray) -> tuple[Form, str]:
    """Return random fields and rules, with their names."""
    waves = np.sin(np.indices(domain.shape).T @ rng.normal(size=len(domain.shape), scale=0.3) + rng.uniform(0, 6)).T
    natural = 1 / np.median(np.linalg.det(tensors.astype(float)) ** (1 / len(domain.shape))) / min(domain.spacing) ** 2
    lumped, cancelling = domain.mass == "lumped", bool(rng.random() < 0.3)
    given = {
        "fick": rng.random() < 0.3,
        "logarithms": rng.random() < 0.3,
        "lumped": lumped,
        "cancelling": cancelling and not lumped,
        "potential": 10 ** rng.uniform(-4, 0) * natural * waves if rng.random() < 0.3 else None,
        "density": np.exp(rng.choice([0.3, 3.0]) * waves) if rng.random() < 0.3 else None,
    }
    return Form(**given), ", ".join(name for name, value in given.items() if value is not None and value is not False)


@cache
def _mask(domain: Domain) -> np.ndarray | None:
    x = np.stack(np.meshgrid(*[np.linspace(-1, 1, n) for n in domain.shape], indexing="ij"), -1)
    if domain.mask == "disc":
        return np.linalg.norm(x, axis=-1) < 1
    if domain.mask == "dumbbell":  # two squares and a bridge of one element
        middle = domain.shape[1] // 2
        inside = np.abs(x[..., 0]) > 0.3
        inside[:, middle : middle + 2] = True
        return inside
    if domain.mask == "islands":  # 16 equal squares
        places = [np.arange(n) % 6 < 5 for n in domain.shape]
        return places[0][:, None] & places[1]
    return None


def _tensors(kind: str, rng: np.random.Generator, shape: tuple[int, ...]) -> np.ndarray:
    d = len(shape)
    identity = np.broadcast_to(np.eye(d), (*shape, d, d))
    x = np.stack(np.meshgrid(*[np.linspace(0, 1, n) for n in shape], indexing="ij"), -1)

    def waves() -> np.ndarray:
        terms = [
            rng.normal() * np.sin(x @ rng.normal(scale=rng.uniform(1, 8), size=d) + rng.uniform(0, 6)) for _ in range(3)
        ]
        return sum(terms, np.zeros(shape))

    if kind == "flat":
        return identity.copy()
    if kind == "nearly flat":
        noise = rng.standard_normal((*shape, d, d)) * 10.0 ** rng.choice([-12, -9, -6])
        return identity + noise + np.swapaxes(noise, -1, -2)
    if kind == "rough":
        a = rng.standard_normal((*shape, d, d)) * rng.choice([0.3, 1, 2])
        return 0.1 * identity + a @ np.swapaxes(a, -1, -2)
    if kind == "jumps":
        return identity * np.where(waves() > 0, 1.0, rng.choice([10.0, 1000.0]))[..., None, None]
    if kind in ("turning", "anisotropic"):
        angle = waves() if kind == "turning" else np.full(shape, rng.uniform(0, 3))
        ratio = rng.choice([3.0, 30.0, 1000.0])
        turn = np.array(identity)
        turn[..., 0, 0] = turn[..., 1, 1] = np.cos(angle)
        turn[..., 0, 1], turn[..., 1, 0] = -np.sin(angle), np.sin(angle)
        return turn @ np.diag([ratio] + [1.0] * (d - 1)) @ np.swapaxes(turn, -1, -2)
    a = np.stack([np.stack([waves() for _ in range(d)], -1) for _ in range(d)], -2)
    values, vectors = np.linalg.eigh(0.5 * rng.choice([0.3, 1, 2]) * (a + np.swapaxes(a, -1, -2)))
    return np.einsum("...ia,...a,...ja->...ij", vectors, np.exp(np.clip(values, -4, 4)), vectors)
