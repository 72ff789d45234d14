"""Rows of large tables: the same, whether found in the text or decoded one after the other."""

import json

import pytest

from p2gs_jax.errors import UserError
from p2gs_jax.scene.drives.tables import (
    read_rows,
)

ROWS = [
    {"token": "a", "of": "x", "values": [1, 2.5, [3]]},
    {"token": "b", "of": "y", "text": 'with "of": "x" and { in it'},
    {"token": "c", "of": "x", "values": []},
    {"token": "d"},
]


@pytest.mark.parametrize("style", [{}, {"indent": 4}, {"separators": (",", ":")}])
def test_rows_are_found(tmp_path, style):
    path = tmp_path / "table.json"
    path.write_text(json.dumps(ROWS, **style) + "\n")
    assert read_rows(path, {}) == ROWS
    assert read_rows(path, {"values": list}, "of", {"x"}) == [ROWS[0], ROWS[2]]
    assert read_rows(path, {}, "token", {"d", "b", "?"}) == [ROWS[1], ROWS[3]]
    assert read_rows(path, {}, "of", {"z"}) == []


def test_an_empty_table_has_no_rows(tmp_path):
    path = tmp_path / "table.json"
    path.write_text("[\n]\n")
    assert read_rows(path, {}, "of", {"x"}) == read_rows(path, {}) == []


@pytest.mark.parametrize("text", ["", "{}", "[1]", '[{"of": "x"', '[{"of": "x"},', "[" * 9999])
def test_what_is_no_table_is_named(tmp_path, text):
    path = tmp_path / "table.json"
    path.write_text(text)
    for column in ("", "of"):
        with pytest.raises(UserError, match=r"table\.json"):
            read_rows(path, {}, column, {"x"})


def test_a_row_without_what_it_needs_is_shown(tmp_path):
    path = tmp_path / "table.json"
    path.write_text(json.dumps(ROWS))
    with pytest.raises(UserError, match=r"no valid 'values'.*token"):
        read_rows(path, {"values": list}, "token", {"d"})
