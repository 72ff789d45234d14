"""Pickled tables, with pandas as the oracle."""

import contextlib
import gzip
import os
import pickle

import numpy as np
import pandas as pd
import pytest

from p2gs_jax.errors import UserError
from p2gs_jax.scene.drives.tables import (
    read_pickled,
)

TABLE = pd.DataFrame(
    {
        "uuid": ["a", "bé", None],
        "x": [1.5, 2.5, np.nan],
        "label": ["Car", "", "Van"],
        "n": [1, 2, 3],
        "stationary": [True, False, True],
        "y": np.array([2, 3, 4], np.float32),
        "mixed": np.array([1, "a", np.float64(3)], object),
    }
)
VARIANTS = {
    "strings": TABLE,
    "objects": TABLE.astype({"uuid": object, "label": object}),
    "numbers": TABLE[["x", "n"]],
    "sliced": TABLE.iloc[1:, ::2],
    "empty": TABLE.iloc[:0],
    "indexed": TABLE.set_index("n"),
    "joined": pd.concat([TABLE, TABLE]),
    "reordered": TABLE[["n", "y", "x", "label"]],
}


def test_a_bomb_is_not_unpacked(tmp_path):
    path = tmp_path / "00.pkl.gz"
    path.write_bytes(gzip.compress(bytes(2**28 + 1), 1))
    with pytest.raises(UserError, match="unpacks to more than 256 MiB"):
        read_pickled(path)


def assert_same(columns, table):
    assert list(columns) == list(table.columns)
    for name, found in columns.items():
        expected = table[name].to_numpy()
        assert len(found) == len(expected)
        for ours, theirs in zip(found, expected, strict=True):
            assert ours == theirs or (pd.isna(ours) and pd.isna(theirs)), name


@pytest.mark.parametrize("storage", ["python", "pyarrow"])
@pytest.mark.parametrize("protocol", [2, 3, 4, 5])
@pytest.mark.parametrize("variant", VARIANTS, ids=str)
def test_what_pandas_writes_today(tmp_path, storage, protocol, variant):
    if storage == "pyarrow":
        pytest.importorskip("pyarrow")
    table = VARIANTS[variant]
    if variant == "strings":
        dtype = pd.StringDtype(storage, na_value=np.nan)
        table = table.astype({"uuid": dtype, "label": dtype})
    path = tmp_path / "t.pkl"
    path.write_bytes(pickle.dumps(table, protocol=protocol))
    assert_same(read_pickled(path), table)


def test_the_real_files_of_an_old_pandas(shared_data):
    root = shared_data("pandaset_002")
    paths = [*sorted(root.glob("annotations/cuboids/*.pkl.gz"))[:5], root / "lidar/00.pkl.gz"]
    for path in paths:
        columns, table = read_pickled(path), pd.read_pickle(path)
        assert list(columns) == list(table.columns)
        for name, found in columns.items():
            if found.dtype == object:
                assert_same({name: found}, table[[name]])
            else:
                np.testing.assert_array_equal(found, table[name].to_numpy())


class Malicious:
    def __reduce__(self):
        return os.system, ("touch malicious",)


class InTheTable:
    def __reduce__(self):
        return eval, ("__import__('os').system('touch malicious')",)


@pytest.mark.parametrize(
    "content",
    [Malicious(), pd.DataFrame({"a": [InTheTable()]}), {"a": Malicious()}],
    ids=["alone", "in a cell", "in a dict"],
)
def test_nothing_is_run(tmp_path, monkeypatch, content):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "t.pkl").write_bytes(pickle.dumps(content))
    with pytest.raises(UserError, match=r"t\.pkl holds no table .*: it holds a .*, no table"):
        read_pickled(tmp_path / "t.pkl")
    assert not (tmp_path / "malicious").exists()


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (pickle.dumps({"a": [1]}), "its content is no DataFrame"),
        (pickle.dumps(TABLE)[:200], "holds no table that can be read"),
        (gzip.compress(pickle.dumps(TABLE))[:300], "holds no table that can be read"),
        (b"", "holds no table that can be read"),
        (b"\x1f\x8bno gzip", "holds no table that can be read"),
        (os.urandom(500), "holds no table that can be read"),
        (pickle.dumps(pd.DataFrame({"c": pd.Categorical(["a"])})), "holds a .*, no table"),
    ],
    ids=["a dict", "cut", "cut gzip", "empty", "bad gzip", "noise", "categories"],
)
def test_what_is_no_table(tmp_path, content, message):
    path = tmp_path / "00.pkl"
    path.write_bytes(content)
    with pytest.raises(UserError, match=message) as info:
        read_pickled(path)
    assert "00.pkl" in str(info.value)


def test_a_missing_file(tmp_path):
    with pytest.raises(UserError, match=r"00\.pkl is missing"):
        read_pickled(tmp_path / "00.pkl")


def test_every_cut_of_a_file_is_complained_about(tmp_path):
    whole = pickle.dumps(TABLE[["x", "n"]])
    path = tmp_path / "t.pkl"
    for end in range(0, len(whole) - 1, 7):
        path.write_bytes(whole[:end])
        with pytest.raises(UserError):
            read_pickled(path)


def test_damaged_bytes_end_in_a_table_or_a_complaint(tmp_path):
    whole = bytearray(pickle.dumps(TABLE))
    path = tmp_path / "t.pkl"
    rng = np.random.default_rng(0)
    for _ in range(300):
        damaged = whole.copy()
        damaged[rng.integers(len(whole))] = rng.integers(256)
        path.write_bytes(damaged)
        with contextlib.suppress(UserError):
            read_pickled(path)
