"""The paper's table and figures: the numbers, and that every picture is drawn."""

import csv

import numpy as np
import pytest

from hks_jax.paper import run, table1

# DESIGN's own figures, to the digits it gives: an independent implementation of the same method.
INDEPENDENT = {50: 0.0580, 100: 0.0223, 200: 0.0056, 400: 0.00085}


def agrees(row: table1.Row) -> bool:
    digits = 5 if row.nodes_per_axis == 400 else 4
    return round(row.nodal, digits) <= INDEPENDENT[row.nodes_per_axis]


# --- Table 1 ----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("n", [50, 100])
def test_table_1_coarse_rows(n):
    row = table1.row(n, table1.QUICK_PAIRS, table1.stored_reference())
    assert agrees(row)
    assert row.nodal == pytest.approx(INDEPENDENT[n], rel=0.01)
    assert row.area_weighted == pytest.approx(row.nodal, rel=0.1)
    assert row.paper > row.nodal


@pytest.mark.slow
def test_table_1_at_the_papers_sizes(tmp_path):
    run(tmp_path, full=True, only=["table1"], echo=lambda text: None)
    with open(tmp_path / "table1.csv", newline="") as file:
        rows = [table1.Row(*map(float, line)) for line in list(csv.reader(file))[1:]]
    assert [row.nodes_per_axis for row in rows] == [50, 100, 200, 400]
    assert all(agrees(row) for row in rows)
    # The signatures converge at second order.
    assert rows[1].nodal / rows[2].nodal > 3.5


@pytest.mark.slow
def test_the_stored_reference_is_what_the_surface_gives():
    computed = table1.computed_reference()
    np.testing.assert_allclose(table1.stored_reference(), computed, rtol=2e-7)


def test_stored_reference_is_symmetric_and_round_trips(tmp_path):
    reference = table1.stored_reference()
    assert reference.shape == (400, 400)
    # The triangulation keeps the symmetry (u, v) → (−u, −v).
    np.testing.assert_allclose(np.roll(reference[::-1, ::-1], 1, axis=(0, 1)), reference, rtol=3e-7)
    table1.store_reference(reference, tmp_path / "again.npy")
    np.testing.assert_array_equal(np.tile(np.load(tmp_path / "again.npy"), (10, 1)), reference)


def test_periodic_interpolation_is_bilinear():
    values = np.random.default_rng(0).random((6, 6))
    fine = table1.interpolate_periodic(values, 4)
    assert fine.shape == (24, 24)
    np.testing.assert_allclose(fine[::4, ::4], values)
    np.testing.assert_allclose(fine[2, 1], 0.5 * (0.75 * (values[0, 0] + values[1, 0]) + 0.25 * (values[0, 1] + values[1, 1])))
    np.testing.assert_allclose(fine[-1, 0], 0.25 * values[-1, 0] + 0.75 * values[0, 0])


def test_relative_difference():
    reference = np.array([[3.0, 4.0]])
    assert table1.relative_difference(reference * 1.5, reference, np.ones((1, 2))) == pytest.approx(0.5)
    assert table1.relative_difference(reference + [[1, 0]], reference, np.array([[16.0, 1.0]])) == pytest.approx(0.5 / np.sqrt(2.5))


def test_table_files_state_their_conventions(tmp_path, monkeypatch):
    def small_row(n, k, reference):
        return table1.Row(n, k, table1.PAPER[n], table1.INDEPENDENT[n], 0.05 / n, 0.04 / n)

    monkeypatch.setattr(table1, "row", small_row)
    lines = []
    paths = run(tmp_path / "new", only=["table1"], echo=lines.append)
    assert [path.name for path in paths] == ["table1.md", "table1.csv"]
    with open(paths[1], newline="") as file:
        rows = list(csv.DictReader(file))
    assert [row["nodes_per_axis"] for row in rows] == ["50", "100", "200"]
    assert [float(row["paper"]) for row in rows] == [0.384, 0.076, 0.0092]
    assert [float(row["independent"]) for row in rows] == [0.058, 0.0223, 0.0056]
    assert float(rows[0]["nodal"]) == 0.001
    text = paths[0].read_text(encoding="utf-8")
    for phrase in ("| 100² | 200 | 0.07600 | 0.02230 |", "√(Σ (h − r)² / Σ r²)", "√|T|", "read from the package"):
        assert phrase in text
    assert lines[-1].startswith("table1: ")


# --- figures ----------------------------------------------------------------------------------------------------------


def test_unknown_items_are_named(tmp_path):
    with pytest.raises(ValueError, match=r"only: got 'figure7', 'table'; expected some of table1, figure1"):
        run(tmp_path, only=["figure7", "table1", "table"])
