"""MATLAB files are read as by scipy, and untrusted ones allocate no memory."""

import struct
import tracemalloc

import numpy as np
import pytest
import scipy.io

from pimper_bench.datasets import matlab
from pimper_bench.datasets.matlab import read_variables

GENERATOR = np.random.default_rng(5)
ARRAYS = {
    "points": GENERATOR.random((3, 5)),
    "grid": GENERATOR.random((2, 3, 4)).astype(np.float32),
    "mask": GENERATOR.random((4, 4)) > 0.5,
    "counts": GENERATOR.integers(-9, 9, (2, 2), dtype=np.int16),
    "one": np.array([[7.0]]),
    "none": np.zeros((0, 3)),
    "text": "not numbers",
    "cells": np.array([1, "a"], dtype=object),
    "complex": np.array([[1 + 2j]]),
}


@pytest.mark.parametrize("packed", [False, True])
def test_arrays_are_read_as_by_scipy(tmp_path, packed):
    scipy.io.savemat(tmp_path / "a.mat", ARRAYS, do_compression=packed)
    oracle = scipy.io.loadmat(tmp_path / "a.mat")
    read = read_variables(tmp_path / "a.mat")
    assert set(read) == set(ARRAYS)
    for name in ("points", "grid", "mask", "counts", "one", "none"):
        np.testing.assert_array_equal(read[name], oracle[name])
        assert read[name].shape == oracle[name].shape
    assert all(read[name] is None for name in ("text", "cells", "complex"))
    only = read_variables(tmp_path / "a.mat", {"one"}.__contains__)
    assert set(only) == set(ARRAYS)
    assert [name for name, array in only.items() if array is not None] == ["one"]


def test_oversized_claims_are_refused_before_allocation(tmp_path, monkeypatch):
    path = tmp_path / "a.mat"
    scipy.io.savemat(path, {"a": np.ones((3, 5))})
    data = path.read_bytes()
    at = data.index(struct.pack("<2I2i", 5, 8, 3, 5))
    wrong = [
        (data[:at] + struct.pack("<2I2i", 5, 8, 2**30, 2**30) + data[at + 16 :], "has the shape"),
        (data[:132] + struct.pack("<I", 2**32 - 1) + data[136:], "truncated"),
        (data[:-8], "truncated"),
        (b"", "not a MATLAB file"),
        (data[:124] + b"\0\2IM" + data[128:], "7.3"),
    ]
    tracemalloc.start()
    for content, why in wrong:
        path.write_bytes(content)
        with pytest.raises(ValueError, match=why):
            read_variables(path)
    monkeypatch.setattr(matlab, "MAX_BYTES", 10**6)
    scipy.io.savemat(path, {"a": np.zeros((500, 500))}, do_compression=True)
    with pytest.raises(ValueError, match="would take more than 1000000 bytes"):
        read_variables(path)
    assert tracemalloc.get_traced_memory()[1] < 2e7
    tracemalloc.stop()
