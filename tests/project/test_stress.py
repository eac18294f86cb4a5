"""A sample of the stress runs: the first seeds of every kind. `make stress` takes an hour for them."""

from importlib import import_module
from pathlib import Path

import pytest
import stress
from stress.harness import run, seeds

KINDS = sorted(path.stem for path in Path(stress.__file__).parent.glob("*.py") if "\ndef check(" in path.read_text())
SEEDS, SECONDS = 20, 2.5


@pytest.mark.slow
@pytest.mark.filterwarnings("always")
@pytest.mark.parametrize("kind", KINDS)
def test_the_first_seeds_are_right_told_or_refused(kind):
    tally = run(kind, import_module(f"stress.{kind}").check, seeds(0, SEEDS), SECONDS, print)
    assert not tally.failures
    assert tally.outcomes.total() > 0
    assert set(tally.outcomes) <= {"right", "told", "refused"}


def test_what_is_wrong_fails_with_its_reproducer():
    def check(seed):
        if error := {2: AssertionError("two"), 3: KeyError("three")}.get(seed):
            raise error
        return "right" if seed else "refused"

    said = []
    tally = run("numbers", check, seeds(0, 5), 60.0, said.append)
    assert dict(tally.outcomes) == {"refused": 1, "right": 2, "failed": 2}
    assert tally.failures == ["numbers 2: AssertionError: two", "numbers 3: KeyError: 'three'"]
    assert any("PYTHONPATH=tests python -m stress numbers --seed 2" in text for text in said)
