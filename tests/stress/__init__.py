"""Random problems against independent answers: whatever is wrong must be refused or told, never silent.

`PYTHONPATH=tests python -m stress --help`; `make stress` runs all of it for an hour.
"""
