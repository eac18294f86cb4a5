"""``python -m hks_jax`` is ``hks-jax``."""

from hks_jax.cli import main

if __name__ == "__main__":
    raise SystemExit(main())
