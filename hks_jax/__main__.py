"""``python -m hks_jax`` runs the command ``hks-jax``."""

from hks_jax.cli import run_and_exit

if __name__ == "__main__":
    run_and_exit()
