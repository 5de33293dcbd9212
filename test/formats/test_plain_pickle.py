"""The reader of plain pickles: what Python's own gives for plain things, and a refusal for everything else."""

from __future__ import annotations

import builtins
import os
import pickle
from collections import OrderedDict
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from crossloc3d_ros.errors import DatasetError
from crossloc3d_ros.formats.plain_pickle import read_plain_pickle

PLAIN = st.recursive(
    st.none()
    | st.booleans()
    | st.integers()
    | st.floats(allow_nan=False)
    | st.text(max_size=20)
    | st.binary(max_size=20),
    lambda inner: (
        st.lists(inner, max_size=6)
        | st.dictionaries(st.integers(-70_000, 70_000) | st.text(max_size=5), inner, max_size=6)
        | st.tuples(inner, inner)
        | st.lists(st.integers(-(2**31), 2**31 - 1), max_size=3000)
    ),
    max_leaves=20,
)


def written(folder: Path, content: Any, protocol: int = 4) -> Path:
    """Return the file that a pickle was written to."""
    path = folder / "some.pickle"
    path.write_bytes(pickle.dumps(content, protocol))
    return path


def comparable(value: Any) -> Any:
    """Return the value with arrays as lists."""
    if isinstance(value, np.ndarray):
        return value.tolist()
    if isinstance(value, dict):
        return {key: comparable(item) for key, item in value.items()}
    if isinstance(value, (list, tuple)):
        return type(value)(comparable(item) for item in value)
    return value


@settings(max_examples=60, deadline=None)
@given(content=PLAIN, protocol=st.integers(0, 5))
def test_plain_things_come_back_as_python_reads_them(
    tmp_path_factory: pytest.TempPathFactory, content: Any, protocol: int
) -> None:
    path = written(tmp_path_factory.mktemp("plain"), content, protocol)
    assert comparable(read_plain_pickle(path)) == content


@pytest.mark.parametrize("protocol", range(6))
def test_numbers_of_numpy_come_back(tmp_path: Path, protocol: int) -> None:
    content = {
        "f8": np.float64(1.5), "i8": np.int64(-7), "f4": np.float32(0.25), "flag": np.bool_(True), "name": np.str_("a"),
        "array": np.arange(6).reshape(2, 3), "fortran": np.asfortranarray(np.arange(6.0).reshape(2, 3)),
        "big_endian": np.array([1.5, 2.5], ">f4"), "set": {1, 2}, "frozen": frozenset({"a"}), "empty": np.zeros(0),
    }  # fmt: skip
    found = read_plain_pickle(written(tmp_path, content, protocol))
    assert found.keys() == content.keys()
    for key, value in content.items():
        np.testing.assert_array_equal(found[key], value, err_msg=key)
    assert type(found["f8"]) is float


@pytest.mark.parametrize("module", ["numpy.core.multiarray", "numpy._core.multiarray"])
def test_both_names_of_numpys_functions_are_known(tmp_path: Path, module: str) -> None:
    data = pickle.dumps([np.float64(2.5), np.arange(3)], 2)
    for name in (b"numpy._core.multiarray", b"numpy.core.multiarray"):
        data = data.replace(b"c" + name + b"\n", b"c" + module.encode() + b"\n")
    (tmp_path / "a").write_bytes(data)
    number, array = read_plain_pickle(tmp_path / "a")
    assert number == 2.5
    assert array.tolist() == [0, 1, 2]


class Attack:
    """An object whose unpickling calls a function."""

    def __init__(self, function: Any, *arguments: Any) -> None:
        self.call = function, arguments

    def __reduce__(self) -> Any:
        """Name the call."""
        return self.call


@pytest.mark.parametrize(
    ("content", "name"),
    [
        (Attack(os.system, "touch done"), "posix.system"),
        (Attack(builtins.eval, "open('done', 'w')"), "builtins.eval"),
        ({0: {"query": "a.bin", "positives": [1, Attack(os.mkdir, "done")]}}, "posix.mkdir"),
        ([np.float64(1.0), {"northing": Attack(getattr, "text", "upper")}], "builtins.getattr"),
        (OrderedDict(a=1), "collections.OrderedDict"),
        (Attack(np.load, "done"), "numpy.load"),
        (Path("a"), "pathlib.PosixPath"),
        (np.array([{}], object), "is damaged"),
        (Attack(bytearray, 10**12), "builtins.bytearray"),
        (np.zeros(2, [("a", "f8")]), "is damaged"),
        (range(3), "builtins.range"),
    ],
)
@pytest.mark.parametrize("protocol", [0, 2, 4, 5])
def test_what_would_call_something_is_refused_by_name_and_not_called(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, content: Any, name: str, protocol: int
) -> None:
    monkeypatch.chdir(tmp_path)
    path = written(tmp_path, content, protocol)
    with pytest.raises(DatasetError) as caught:
        read_plain_pickle(path)
    known = {name, name.replace("builtins", "__builtin__").replace("range", "xrange"), name.replace("posix", "nt")}
    assert any(word in str(caught.value) for word in known), caught.value
    assert [p.name for p in tmp_path.iterdir()] == ["some.pickle"]


@pytest.mark.parametrize(
    "code",
    [
        b"\x80\x04\x8c\x05numpy\x8c\x05dtype\x93.",  # a name and no call
        b"\x80\x04\x8c\x05numpy\x8c\x07ndarray\x93K\x01\x85R.",  # a call of what is only a name
        b"\x80\x04]\x94h\x00a.",  # a list that holds itself
        b"\x80\x04h\x05.",  # an unknown memo
        b"\x80\x04}(K\x01u.",  # a key without a value
        b"\x80\x04}]K\x01s.",  # a list as key
        b"cos\nsystem\n(S'echo'\ntR.",  # the classic
        b"\x80\x02cos\nsystem\nq\x00)\x81.",  # an object
        b"(i__main__\nA\n.",
        b"\x80\x04P1\n.",
        b"\x80\x04K\x01",  # no end
        b"\x80\x04.",
        b"not a pickle",
        b"",
    ],
)
def test_hand_made_pickles_are_refused(tmp_path: Path, code: bytes) -> None:
    path = tmp_path / "hand.pickle"
    path.write_bytes(code)
    if code == b"\x80\x04]\x94h\x00a.":
        found = read_plain_pickle(path)
        assert isinstance(found, list)
        return
    with pytest.raises(DatasetError, match=str(path)):
        read_plain_pickle(path)


@settings(max_examples=150, deadline=None)
@given(st.binary(max_size=200))
def test_noise_is_refused_and_never_crashes(tmp_path_factory: pytest.TempPathFactory, noise: bytes) -> None:
    path = tmp_path_factory.mktemp("noise") / "noise.pickle"
    path.write_bytes(b"\x80\x04" + noise)
    try:
        read_plain_pickle(path)
    except DatasetError as error:
        assert str(path) in str(error)


def test_a_pickle_that_is_cut_short_anywhere_is_refused(tmp_path: Path) -> None:
    whole = pickle.dumps({i: {"query": f"{i}.bin", "positives": list(range(300))} for i in range(3)}, 4)
    path = tmp_path / "cut.pickle"
    for length in range(1, len(whole), 37):
        path.write_bytes(whole[:length])
        with pytest.raises(DatasetError, match="damaged or cut short"):
            read_plain_pickle(path)


def test_a_file_beyond_the_bound_is_refused(tmp_path: Path) -> None:
    with pytest.raises(DatasetError, match="more than 10"):
        read_plain_pickle(written(tmp_path, list(range(100))), most_bytes=10)


def test_a_missing_file_is_named(tmp_path: Path) -> None:
    with pytest.raises(DatasetError, match=r"none\.pickle is missing"):
        read_plain_pickle(tmp_path / "none.pickle")


def test_values_may_be_made_smaller_as_they_are_read(tmp_path: Path) -> None:
    content = {i: {"query": str(i), "negatives": list(range(5000)), "mixed": [i, "a"], "none": []} for i in range(4)}
    found = read_plain_pickle(
        written(tmp_path, content), lambda key, value: len(value) if key == "negatives" else value
    )
    assert found == {i: {"query": str(i), "negatives": 5000, "mixed": [i, "a"], "none": []} for i in range(4)}


def test_a_list_that_is_named_twice_is_read_twice(tmp_path: Path) -> None:
    shared = [1, 2, 70_000]
    found = read_plain_pickle(written(tmp_path, {"a": shared, "b": shared, "c": [shared, shared]}))
    assert found["a"].tolist() == found["b"].tolist() == found["c"][1].tolist() == shared
