"""The descriptor index: exact and inverted search, removal, filters, refusals."""

from __future__ import annotations

import numpy as np
import pytest

from magic_core.errors import AlreadyExists, InvalidInput, NotFound
from magic_server.places import DescriptorIndex


def unit_vectors(count: int, dimension: int = 32, seed: int = 0) -> np.ndarray:
    vectors = np.random.default_rng(seed).normal(size=(count, dimension))
    return vectors / np.linalg.norm(vectors, axis=1, keepdims=True)


def filled(vectors: np.ndarray, **settings: int) -> DescriptorIndex:
    index = DescriptorIndex(vectors.shape[1], **settings)
    for number, vector in enumerate(vectors):
        index.add(f"v{number}", vector)
    return index


def test_finds_the_nearest_by_cosine():
    vectors = unit_vectors(200)
    index = filled(vectors)
    query = unit_vectors(1, seed=9)[0]
    similarity = vectors @ query
    expected = np.argsort(-similarity)[:5]
    found = index.query(3.0 * query, 5)
    assert [name for name, _ in found] == [f"v{number}" for number in expected]
    np.testing.assert_allclose([s for _, s in found], similarity[expected], atol=1e-6)


def test_removed_vectors_are_not_found_and_can_come_back():
    vectors = unit_vectors(20)
    index = filled(vectors)
    index.remove("v7")
    assert "v7" not in index
    assert len(index) == 19
    assert "v7" not in [name for name, _ in index.query(vectors[7], 19)]
    index.add("v7", vectors[7])
    assert index.query(vectors[7], 1)[0][0] == "v7"


def test_search_among_some_names_only():
    vectors = unit_vectors(30)
    index = filled(vectors)
    found = index.query(vectors[3], 10, among=["v4", "v9", "unknown"])
    assert {name for name, _ in found} == {"v4", "v9"}


def test_ties_are_answered_oldest_first():
    index = DescriptorIndex(4)
    for name in ("b", "a", "c"):
        index.add(name, [1, 0, 0, 0])
    assert [name for name, _ in index.query([1, 0, 0, 0], 3)] == ["b", "a", "c"]


def test_becomes_an_inverted_file_beyond_its_limit_and_still_finds_and_removes():
    vectors = unit_vectors(1500, dimension=16)
    index = filled(vectors, exact_limit=1000)
    assert not index.is_exact
    hits = sum(index.query(vector, 1)[0][0] == f"v{n}" for n, vector in enumerate(vectors))
    assert hits >= 0.99 * len(vectors)  # 8-bit codes; measured 1500
    index.remove("v12")
    assert index.query(vectors[12], 1)[0][0] != "v12"
    assert [name for name, _ in index.query(vectors[5], 3, among=["v5"])] == ["v5"]


def test_empty_index_answers_nothing():
    assert DescriptorIndex(8).query(np.ones(8), 3) == []


def test_refuses_bad_vectors_and_names():
    index = filled(unit_vectors(3, dimension=8))
    with pytest.raises(InvalidInput, match="expected 8"):
        index.add("short", np.ones(7))
    with pytest.raises(InvalidInput, match="finite"):
        index.query(np.full(8, np.nan), 1)
    with pytest.raises(AlreadyExists):
        index.add("v0", np.ones(8))
    with pytest.raises(NotFound):
        index.remove("v99")


def test_many_loaded_at_once_are_found_as_those_added_one_by_one():
    vectors = unit_vectors(300)
    names = [f"v{number}" for number in range(300)]
    for limit in (1000, 100):
        index = DescriptorIndex(32, exact_limit=limit)
        index.load(names[:150], vectors[:150])
        index.load(names[150:], vectors[150:])
        assert len(index) == 300
        assert index.is_exact == (limit == 1000)
        assert index.query(vectors[7], 1)[0][0] == "v7"
        with pytest.raises(AlreadyExists):
            index.load(["new", "v3"], vectors[:2])
        assert "new" not in index
