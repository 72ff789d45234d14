"""PLY tables against plyfile, and errors for other files."""

import tracemalloc

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from plyfile import PlyData, PlyElement

from p2gs_jax.core.ply import header_of, read_table, refusing
from p2gs_jax.errors import UserError

TYPES = {
    **{"char": "i1", "uchar": "u1", "short": "i2", "ushort": "u2"},
    **{"int": "i4", "uint": "u4", "float": "f4", "double": "f8"},
    **{"int8": "i1", "uint8": "u1", "int16": "i2", "uint16": "u2"},
    **{"int32": "i4", "uint32": "u4", "float32": "f4", "float64": "f8"},
}
CODES = sorted(set(TYPES.values()))
FORMATS = {"ascii": "=", "binary_little_endian": "<", "binary_big_endian": ">"}
AXES = [f"property float {axis}" for axis in "xyz"]
FACES = ["element face 2", "property list uchar int vertex_indices"]


def ply(kind, lines, data=b"", newline="\n"):
    return newline.join(["ply", f"format {kind} 1.0", *lines, "end_header", ""]).encode() + data


def write(path, data):
    path.write_bytes(data)
    return path


def numbers(rng, code, shape):
    """Draw values over the whole range of a type."""
    kind = np.dtype(code)
    if kind.kind == "f":
        odd = np.array([np.nan, np.inf, -np.inf, -0.0, np.finfo(kind).max, np.finfo(kind).tiny])
        drawn = rng.normal(size=shape) * 10.0 ** rng.integers(-30, 30, shape)
        return np.where(rng.random(shape) < 0.2, rng.choice(odd, shape), drawn).astype(kind)
    ends = np.iinfo(kind)
    return rng.integers(ends.min, ends.max, shape, dtype=kind, endpoint=True)


tables = st.lists(
    st.tuples(st.integers(0, 5), st.lists(st.sampled_from(CODES), min_size=1, max_size=4)),
    min_size=1,
    max_size=3,
)
seeds = st.integers(0, 2**32 - 1)


def element(rng, name, count, codes):
    """Return an element of plyfile with random values."""
    table = np.empty(count, [(f"{name}_{k}", code) for k, code in enumerate(codes)])
    for column in table.dtype.names:
        table[column] = numbers(rng, table.dtype[column], count)
    return PlyElement.describe(table, name)


@given(tables, st.sampled_from(list(FORMATS)), seeds)
def test_every_table_is_read_as_by_plyfile(tmp_path_factory, elements, kind, seed):
    rng = np.random.default_rng(seed)
    path = tmp_path_factory.getbasetemp() / "drawn.ply"
    made = [element(rng, "abc"[k], *shape) for k, shape in enumerate(elements)]
    # The reader skips lists behind the tables.
    faces = np.empty(1, [("corners", object)])
    faces[0] = (np.arange(3, dtype="i4"),)
    made.append(PlyElement.describe(faces, "face"))
    notes = {"comments": ["of a test", "end_header"], "obj_info": ["1 2"]}
    PlyData(made, text=kind == "ascii", byte_order=FORMATS[kind], **notes).write(str(path))
    theirs = PlyData.read(str(path))
    for table in made[:-1]:
        rows, expected = read_table(path, table.name), theirs[table.name].data
        assert rows.dtype == expected.dtype
        for name in rows.dtype.names:
            np.testing.assert_array_equal(rows[name], expected[name])


def test_comments_are_one_line_of_ascii():
    lines = header_of(np.dtype([("x", "<f4")]), 0, ["Straße\nend_header"]).splitlines()
    assert lines[2] == rb"comment Stra\xdfe\nend_header"
    with pytest.raises(KeyError):
        header_of(np.dtype([("x", "<i8")]), 0)


@pytest.mark.parametrize("kind", FORMATS)
@pytest.mark.parametrize("name", TYPES)
def test_all_names_of_types_are_read(tmp_path, name, kind):
    values = np.array([7, 100], FORMATS[kind] + TYPES[name])
    data = b"7\n100\n" if kind == "ascii" else values.tobytes()
    path = write(tmp_path / "a.ply", ply(kind, ["element e 2", f"property {name} x"], data))
    rows = read_table(path, "e")
    assert rows.dtype["x"] == values.dtype
    np.testing.assert_array_equal(rows["x"], values)


POINTS = np.array([[0, 0, 1], [0, 1, 0]], np.float32)
TEXT = b"0 0 1\n0 1 0\n"
VERTICES = ["element vertex 2", *AXES]


def positions(rows):
    return np.stack([rows[axis] for axis in "xyz"], 1)


@pytest.mark.parametrize("newline", ["\n", "\r\n", "\r"])
@pytest.mark.parametrize("kind", ["ascii", "binary_little_endian"])
def test_every_kind_of_line_end_is_read(tmp_path, newline, kind):
    # The first byte of the data, 10, is no line's end.
    points = POINTS.copy()
    points.view("<i4")[0, 0] = 10
    data = TEXT.replace(b"\n", newline.encode()) if kind == "ascii" else points.tobytes()
    path = write(tmp_path / "a.ply", ply(kind, VERTICES, data, newline))
    expected = POINTS if kind == "ascii" else points
    np.testing.assert_array_equal(positions(read_table(path, "vertex")), expected)


@pytest.mark.parametrize("kind", FORMATS)
def test_a_file_that_was_cut_anywhere_is_refused(tmp_path, kind):
    data = TEXT if kind == "ascii" else POINTS.astype(FORMATS[kind] + "f4").tobytes()
    path, data = tmp_path / "a.ply", ply(kind, VERTICES, data)
    for end in range(len(data) + 1):
        write(path, data[:end])
        # The last line of a text may lack its end.
        if end < len(data) - (kind == "ascii"):
            with pytest.raises(ValueError):  # noqa: PT011
                read_table(path, "vertex")
        else:
            np.testing.assert_array_equal(positions(read_table(path, "vertex")), POINTS)


COLORED = [*VERTICES, "property uchar red"]
WHOLE = ply("ascii", VERTICES, TEXT)
# A file, or the lines and data behind "ply" and the format; the words of its error.
REFUSED = {
    "no count": ((["element vertex", *AXES], TEXT), r"line 3 of its header, 'element vertex', is"),
    "a type unknown": ((["element vertex 2", "property int64 x"], TEXT), r"line 4 .*int64 x', is"),
    "a property twice": (([*VERTICES, AXES[0]], TEXT), r"'property float x', is .*there twice"),
    "a property of nothing": (([AXES[0], *VERTICES], TEXT), r"line 3 of its header.*misplaced"),
    "a format twice": ((["format ascii 1.0", *VERTICES], TEXT), r"'format ascii 1.0', is .*twice"),
    "no ASCII": ((["comment Straße", *VERTICES], TEXT), r"'ascii' codec can't decode"),
    "no vertices": ((["element points 2", *AXES], TEXT), r"it has no element 'vertex'"),
    "lists before": (([*FACES, *VERTICES], TEXT), r"its element 'face' has lists"),
    "an axis missing": ((["element vertex 2", AXES[0]], b"1\n2\n"), r"no field of name y"),
    "a row short": ((VERTICES, b"0 0 1\n0 1\n"), r"requires 3 columns but 2 were found at row 2"),
    "a row long": ((VERTICES, b"0 0 1 5\n0 1 0\n"), r"requires 3 columns but 4 were found"),
    "a word": ((VERTICES, b"0 0 x\n0 1 0\n"), r"could not convert string 'x' to float32"),
    "a colour of 256": ((COLORED, b"0 0 1 256\n0 1 0 0\n"), r"'256' to uint8"),
    "a huge count": ((["element vertex 99999999999", *AXES], TEXT), r"announces 99999999999 row"),
    "a count without end": ((["element vertex " + "9" * 5000], TEXT), r"limit \(4300 digits\)"),
    "empty": (b"", r"is not a valid PLY of points: it is empty"),
    "no end": (WHOLE.replace(b"end_header\n", b""), r"it has no line 'end_header'"),
    "no format": (WHOLE.replace(b"format ascii 1.0\n", b""), r"line 2 of its header.*misplaced"),
    "nothing at all": (b"ply\ncomment\nend_header\n", r"its header states no format"),
}


def refused(path, message):
    with pytest.raises(UserError, match=message) as error, refusing(path, "points", fix="write it"):
        positions(read_table(path, "vertex"))
    assert str(error.value).startswith(str(path))
    assert error.value.fix == "write it"


@pytest.mark.parametrize(("content", "message"), REFUSED.values(), ids=REFUSED)
def test_broken_files_are_refused_with_their_fault(tmp_path, content, message):
    data = content if isinstance(content, bytes) else ply("ascii", *content)
    refused(write(tmp_path / "a.ply", data), message)


def test_missing_files_and_folders_are_refused(tmp_path):
    refused(tmp_path / "nowhere.ply", r"is not a valid PLY of points: .*No such file")
    refused(tmp_path, r"is not a valid PLY of points: .*directory")


def test_rows_are_mapped_instead_of_read(tmp_path):
    rows = np.zeros(10**6, [("x", "<f8")])
    data = header_of(rows.dtype, len(rows)) + rows.tobytes()
    path = write(tmp_path / "a.ply", data)
    del data
    tracemalloc.start()
    assert len(read_table(path, "vertex")) == len(rows)
    assert tracemalloc.get_traced_memory()[1] < rows.nbytes / 4
    tracemalloc.stop()
