"""Tables of drives: rows of large JSON lists, Arrow, and pickled tables, as pandas reads them."""

import gzip
import json
import os
import pickle
import sys

import numpy as np
import pandas as pd
import pytest
from scene.drives.writers_pandaset import as_published
from scene.helpers import Malicious, refused

from p2gs_jax.scene.drives.tables import read_feather, read_pickled, read_rows

ROWS = [
    {"token": "a", "of": "x", "values": [1, 2.5, [3]]},
    {"token": "b", "of": "y", "text": 'with "of": "x" and { in it'},
    {"token": "c", "of": "x", "values": []},
    {"token": "d"},
]


@pytest.mark.parametrize("style", [{}, {"indent": 4}, {"separators": (",", ":")}])
def test_selected_rows_are_read_whatever_the_style_of_the_text(tmp_path, style):
    path = tmp_path / "table.json"
    path.write_text(json.dumps(ROWS, **style) + "\n")
    assert read_rows(path, {}) == ROWS
    assert read_rows(path, {"values": list}, "of", {"x"}) == [ROWS[0], ROWS[2]]
    assert read_rows(path, {}, "token", {"d", "b", "?"}) == [ROWS[1], ROWS[3]]
    assert read_rows(path, {}, "of", {"z"}) == []
    with refused(r"no valid 'values'.*token"):
        read_rows(path, {"values": list}, "token", {"d"})
    path.write_text("[\n]\n")
    assert read_rows(path, {}, "of", {"x"}) == read_rows(path, {}) == []


@pytest.mark.parametrize(
    "text", ["", "{}", "[1]", '[{"of": "x"', '[{"of": "x"},', "[" * 9999, "\udcff"]
)
def test_texts_that_are_not_tables_of_rows_are_refused(tmp_path, text):
    path = tmp_path / "table.json"
    path.write_text(text, errors="surrogateescape")
    for column in ("", "of"):
        with refused(r"table\.json is not a valid table"):
            read_rows(path, {}, column, {"x"})


def test_without_pyarrow_the_error_names_the_command_that_installs_it(tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "pyarrow", None)
    with refused(r"pip install 'p2gs-jax\[drives\]'"):
        read_feather(tmp_path / "annotations.feather", [])


TABLE = as_published(
    [
        {"uuid": "a", "x": 1.5, "label": "Car", "n": 1, "stationary": True},
        {"uuid": "bé", "x": 2.5, "label": "", "n": 2, "stationary": False},
        {"uuid": None, "x": np.nan, "label": "Van", "n": 3, "stationary": True},
    ]
).assign(y=np.array([2, 3, 4], np.float32))
TABLE.columns = TABLE.columns.astype(object)
VARIANTS = {
    "all": TABLE,
    "numbers": TABLE[["x", "n"]],
    "sliced": TABLE.iloc[1:, ::2],
    "empty": TABLE.iloc[:0],
    "indexed": TABLE.set_index("n"),
    "joined": pd.concat([TABLE, TABLE]),
    "reordered": TABLE[["n", "y", "x", "label"]],
}


@pytest.mark.parametrize("protocol", [3, 4, 5])
@pytest.mark.parametrize("variant", VARIANTS)
def test_tables_that_pandas_pickled_are_read(tmp_path, protocol, variant):
    table = VARIANTS[variant]
    (tmp_path / "t.pkl").write_bytes(pickle.dumps(table, protocol=protocol))
    columns = read_pickled(tmp_path / "t.pkl")
    assert list(columns) == list(table.columns)
    for name, found in columns.items():
        expected = table[name].to_numpy()
        if found.dtype != object:
            np.testing.assert_array_equal(found, expected)
        else:
            for ours, theirs in zip(found, expected, strict=True):
                assert ours == theirs or (pd.isna(ours) and pd.isna(theirs)), name


SYSTEM = Malicious(os.system, ("touch malicious",))
IN_THE_TABLE = Malicious(eval, ("__import__('os').system('touch malicious')",))
UNREADABLE = "is not a table that can be read"
REFUSED = {
    "call": (pickle.dumps(SYSTEM), "00.pkl is not a table .*: it holds a posix"),
    "call in cell": (pickle.dumps(pd.DataFrame({"a": [IN_THE_TABLE]})), "holds a (builtins|pan)"),
    "dict": (pickle.dumps({"a": [1]}), "its content is not a DataFrame"),
    "cut gzip": (gzip.compress(pickle.dumps(TABLE))[:300], UNREADABLE),
    "noise": (b"\x17" * 500, UNREADABLE),
    "categories": (pickle.dumps(pd.DataFrame({"c": pd.Categorical(["a"])})), "it holds a pandas"),
    "bomb": (65 * gzip.compress(bytes(2**22), 1), "unpacks to more than 256 MiB"),
}


@pytest.mark.parametrize(("content", "words"), REFUSED.values(), ids=REFUSED)
def test_other_pickles_are_refused_and_never_executed(tmp_path, monkeypatch, content, words):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "00.pkl").write_bytes(content)
    with refused(words, "00.pkl"):
        read_pickled(tmp_path / "00.pkl")
    assert not (tmp_path / "malicious").exists()
