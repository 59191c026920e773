"""The descriptor index: exact and inverted search, removal, filters, refusals."""

from __future__ import annotations

import numpy as np
import pytest

from magic_core.errors import AlreadyExists, InvalidInput, NotFound
from magic_server.places import DescriptorIndex, Hit, Place


def unit_vectors(count: int, dimension: int = 32, seed: int = 0) -> np.ndarray:
    vectors = np.random.default_rng(seed).normal(size=(count, dimension))
    return vectors / np.linalg.norm(vectors, axis=1, keepdims=True)


def filled(vectors: np.ndarray, **settings: int) -> DescriptorIndex:
    index = DescriptorIndex(vectors.shape[1], **settings)
    for number, vector in enumerate(vectors):
        index.add(Place(f"v{number}", vector))
    return index


def names_of(found: list[Hit]) -> list[str]:
    return [hit.name for hit in found]


def test_finds_the_nearest_by_cosine():
    vectors = unit_vectors(200)
    index = filled(vectors)
    query = unit_vectors(1, seed=9)[0]
    similarity = vectors @ query
    expected = np.argsort(-similarity)[:5]
    found = index.query(3.0 * query, 5)
    assert names_of(found) == [f"v{number}" for number in expected]
    np.testing.assert_allclose([hit.similarity for hit in found], similarity[expected], atol=1e-6)


def test_removed_vectors_are_not_found_and_can_come_back():
    vectors = unit_vectors(20)
    index = filled(vectors)
    index.remove("v7")
    assert "v7" not in index
    assert len(index) == 19
    assert "v7" not in names_of(index.query(vectors[7], 19))
    index.add(Place("v7", vectors[7]))
    assert names_of(index.query(vectors[7], 1)) == ["v7"]


def test_search_among_some_names_only():
    vectors = unit_vectors(30)
    index = filled(vectors)
    found = index.query(vectors[3], 10, among=["v4", "v9", "unknown"])
    assert {*names_of(found)} == {"v4", "v9"}


def test_ties_are_answered_oldest_first():
    index = DescriptorIndex(4)
    for name in ("b", "a", "c"):
        index.add(Place(name, [1, 0, 0, 0]))
    assert names_of(index.query([1, 0, 0, 0], 3)) == ["b", "a", "c"]


def test_becomes_an_inverted_file_beyond_its_limit_and_still_finds_and_removes():
    vectors = unit_vectors(1500, dimension=16)
    index = filled(vectors, exact_limit=1000)
    assert not index.is_exact
    hits = sum(names_of(index.query(vector, 1)) == [f"v{n}"] for n, vector in enumerate(vectors))
    assert hits >= 0.99 * len(vectors)  # 8-bit codes; measured 1500
    index.remove("v12")
    assert names_of(index.query(vectors[12], 1)) != ["v12"]
    assert names_of(index.query(vectors[5], 3, among=["v5"])) == ["v5"]


def test_empty_index_answers_nothing():
    assert DescriptorIndex(8).query(np.ones(8), 3) == []


def test_refuses_bad_vectors_and_names():
    index = filled(unit_vectors(3, dimension=8))
    with pytest.raises(InvalidInput, match="expected 8"):
        index.add(Place("short", np.ones(7)))
    with pytest.raises(InvalidInput, match="finite"):
        index.query(np.full(8, np.nan), 1)
    with pytest.raises(AlreadyExists):
        index.add(Place("v0", np.ones(8)))
    with pytest.raises(InvalidInput, match="expected 8"):
        index.add(Place("with keyframe", np.ones(8), [(1, np.ones(7))]))
    assert "with keyframe" not in index
    assert index.vectors == 3
    with pytest.raises(NotFound):
        index.remove("v99")


def test_many_loaded_at_once_are_found_as_those_added_one_by_one():
    vectors = unit_vectors(300)
    places = [Place(f"v{number}", vector) for number, vector in enumerate(vectors)]
    for limit in (1000, 100):
        index = DescriptorIndex(32, exact_limit=limit)
        index.load(places[:150])
        index.load(places[150:])
        assert len(index) == 300
        assert index.is_exact == (limit == 1000)
        assert names_of(index.query(vectors[7], 1)) == ["v7"]
        for places_with_one_twice in ([Place("new", vectors[0]), places[3]], [places[3]] * 2):
            with pytest.raises(AlreadyExists):
                index.load(places_with_one_twice)
        assert "new" not in index


def with_keyframes(count: int, each: int, dimension: int = 24) -> tuple[list[Place], np.ndarray]:
    """Places, and their vectors (count, 1 + each, dimension); keyframes are numbered 3, 6, 9..."""
    vectors = unit_vectors(count * (1 + each), dimension).reshape(count, 1 + each, dimension)
    places = [
        Place(f"v{number}", own[0], [(3 * k, vector) for k, vector in enumerate(own[1:], 1)])
        for number, own in enumerate(vectors)
    ]
    return places, vectors


def best_by_hand(vectors: np.ndarray, queries: np.ndarray) -> list[Hit]:
    """Of every place: its best vector to any of the queries, best first."""
    similarity = np.einsum("nkd,qd->nkq", vectors, queries)
    found = []
    for number, own in enumerate(similarity):
        k, q = np.unravel_index(own.argmax(), own.shape)
        found.append(Hit(f"v{number}", float(own[k, q]), 3 * int(k), int(q)))
    return sorted(found, key=lambda hit: -hit.similarity)


@pytest.mark.parametrize("each", [1, 4, 30])
@pytest.mark.parametrize("queries", [1, 3])
def test_a_place_is_found_once_by_the_best_of_its_views(each: int, queries: int) -> None:
    places, vectors = with_keyframes(60, each)
    index = DescriptorIndex(24)
    index.load(places)
    assert (len(index), index.vectors) == (60, 60 * (1 + each))
    asked = unit_vectors(queries, 24, seed=5)
    # One place whose every view is nearer than any other's: it must not take all the room.
    index.remove("v7")
    crowd = asked[0] + 0.3 * unit_vectors(1 + each, 24, seed=6)  # apart by more than rounding
    vectors[7] = crowd / np.linalg.norm(crowd, axis=1, keepdims=True)
    index.add(Place("v7", vectors[7, 0], [(3 * k, v) for k, v in enumerate(vectors[7, 1:], 1)]))
    expected = best_by_hand(vectors, asked)
    for count in (1, 10, 60, 1000):
        found = index.query(asked, count)
        assert len(found) == min(count, 60)
        for mine, right in zip(found, expected, strict=False):
            assert (mine.name, mine.keyframe, mine.query) == (
                right.name, right.keyframe, right.query,
            )  # fmt: skip
            assert mine.similarity == pytest.approx(right.similarity, abs=1e-5)


def test_an_inverted_file_finds_places_by_their_keyframes_too() -> None:
    places, vectors = with_keyframes(300, 4, dimension=16)
    index = DescriptorIndex(16, exact_limit=1000)  # it counts vectors
    index.load(places)
    assert not index.is_exact
    found = [index.query(own[3], 5) for own in vectors]
    assert all(len({*names_of(hits)}) == 5 for hits in found)
    firsts = [(hits[0].name, hits[0].keyframe) for hits in found]
    right = sum(first == (f"v{number}", 9) for number, first in enumerate(firsts))
    assert right >= 0.99 * len(vectors)  # 8-bit codes; measured 300


@pytest.mark.parametrize("exact_limit", [1000, 100])
def test_what_is_removed_is_found_by_none_of_its_views(exact_limit: int) -> None:
    places, vectors = with_keyframes(50, 3)
    index = DescriptorIndex(24, exact_limit=exact_limit)
    index.load(places)
    index.remove("v4")
    assert (len(index), index.vectors) == (49, 49 * 4)
    for vector in vectors[4]:
        assert "v4" not in names_of(index.query(vector, 50))
    index.add(places[4])
    hit = index.query(vectors[4, 2], 1)[0]
    assert (hit.name, hit.keyframe) == ("v4", 6)


def test_a_filter_lets_every_view_of_its_names_through() -> None:
    places, vectors = with_keyframes(40, 4)
    index = DescriptorIndex(24)
    index.load(places)
    found = index.query(vectors[9, 4], 10, among=["v9", "v11", "unknown"])
    assert names_of(found) == ["v9", "v11"]
    assert found[0].keyframe == 12


def test_of_equal_views_the_anchor_is_named() -> None:
    index = DescriptorIndex(4)
    index.add(Place("a", [1, 0, 0, 0], [(2, [1, 0, 0, 0])]))
    index.add(Place("b", [1, 0, 0, 0]))
    found = index.query([[1, 0, 0, 0]] * 2, 5)
    assert [(hit.name, hit.keyframe, hit.query) for hit in found] == [("a", 0, 0), ("b", 0, 0)]
