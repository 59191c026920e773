"""Named descriptors and their nearest neighbours by cosine similarity, on FAISS.

Exact search up to `EXACT_LIMIT` vectors. Beyond it, an inverted file with 8-bit codes, which is
the FAISS index that is fast at a million vectors and still supports removal (HNSW does not).
"""

from __future__ import annotations

from collections.abc import Collection, Sequence
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from magic_core.errors import AlreadyExists, InvalidInput, NotFound
from magic_server.places.hits import Hit, Place, best_of_each

EXACT_LIMIT = 100_000
TRAINING_VECTORS_PER_LIST = 50
TRAINING_ROUNDS = 4
"""Of k-means, which finds the lists: ten take twice as long and find nothing more."""
LISTS_PROBED = 64
"""Of 2,000: of ten descriptors of a place among a million they find more than 97 %."""
LOADED_AT_ONCE = 10_000
BLAS_THRESHOLD = 3072
"""FAISS skips BLAS for small batches of long vectors, which is 18 times slower at 384 numbers."""


class DescriptorIndex:
    """Unit vectors of one encoder under their names. Not thread-safe: one owner.

    A name may have several vectors, its anchor's and those of keyframes; it is found by the best.
    """

    def __init__(self, dimension: int, *, exact_limit: int = EXACT_LIMIT) -> None:
        if dimension < 1:
            raise InvalidInput.field("dimension", f"{dimension}: expected at least 1")
        import faiss

        faiss.cvar.distance_compute_blas_threshold = BLAS_THRESHOLD
        self._faiss: Any = faiss
        self.dimension = dimension
        self._exact_limit = exact_limit
        self._index: Any = faiss.IndexIDMap2(faiss.IndexFlatIP(dimension))
        self._is_exact = True
        self._id_of: dict[str, int] = {}  # of the anchor
        self._names: list[str] = []  # by number of a vector; empty for what was removed
        # Of keyframes alone, so that they cost nothing where there are none.
        self._others_of: dict[str, tuple[int, ...]] = {}
        self._keyframe_of: dict[int, int] = {}

    def __len__(self) -> int:
        return len(self._id_of)

    def __contains__(self, name: str) -> bool:
        return name in self._id_of

    @property
    def is_exact(self) -> bool:
        """Whether every query compares with every vector."""
        return self._is_exact

    @property
    def vectors(self) -> int:
        """How many vectors there are, those of keyframes included."""
        return self._index.ntotal

    def add(self, place: Place) -> None:
        """Store the vectors (dimension,) of a place, normalised.

        Raises AlreadyExists for a known name, before anything is stored.
        """
        self.load([place])

    def load(self, places: Sequence[Place]) -> None:
        """Store many places at once: one by one, a million take an inverted file minutes.

        Raises AlreadyExists for a known name, before anything is stored.
        """
        if held := [place.name for place in places if place.name in self._id_of]:
            raise AlreadyExists(f"descriptor {held[0]!r} is in the index already; remove it first")
        if len({place.name for place in places}) < len(places):
            raise AlreadyExists("descriptors under one name twice")
        step = max(1, LOADED_AT_ONCE // max((1 + len(p.keyframes) for p in places), default=1))
        for first in range(0, len(places), step):
            self._store(places[first : first + step])
            if self._is_exact and self.vectors > self._exact_limit:
                self._become_inverted_file()

    def remove(self, name: str) -> None:
        """Forget a place with all its vectors. Raises NotFound for an unknown name."""
        if name not in self._id_of:
            raise NotFound(f"descriptor {name!r} is not in the index")
        identifiers = [self._id_of.pop(name), *self._others_of.pop(name, ())]
        for identifier in identifiers:
            self._names[identifier] = ""
            self._keyframe_of.pop(identifier, None)
        self._index.remove_ids(np.array(identifiers, dtype=np.int64))

    def query(
        self, vectors: ArrayLike, k: int, *, among: Collection[str] | None = None
    ) -> list[Hit]:
        """The k nearest places to a vector (dimension,), or to the nearest of several (n,
        dimension): each once with its best similarity, best first, ties by age.

        `among` keeps the search to some names (of one session, say); unknown ones are ignored.
        """
        if k < 1 or not self._id_of:
            return []
        rows = np.asarray(vectors, dtype=np.float32)
        rows = np.concatenate([self._unit_row(row) for row in (rows if rows.ndim > 1 else [rows])])
        parameters = self._parameters(among)
        wanted = min(k, self.vectors)
        while True:
            similarities, identifiers = self._index.search(rows, wanted, params=parameters)
            found = [
                (-float(similarity), int(identifier), query)
                for query in range(len(rows))
                for identifier, similarity in zip(
                    identifiers[query], similarities[query], strict=True
                )
                if identifier >= 0
            ]
            # Several vectors of one place take several of the neighbours: then ask for more.
            if wanted == self.vectors or self._are_enough(identifiers, k):
                return best_of_each(map(self._hit, sorted(found)), k)
            wanted = min(2 * wanted, self.vectors)

    def _are_enough(self, identifiers: NDArray[np.int64], k: int) -> bool:
        """Whether each query has found k places, or everything that it can."""
        return all(
            row[-1] < 0 or len({self._names[identifier] for identifier in row.tolist()}) >= k
            for row in identifiers
        )

    def _hit(self, found: tuple[float, int, int]) -> Hit:
        negative, identifier, query = found
        keyframe = self._keyframe_of.get(identifier, 0)
        return Hit(self._names[identifier], -negative, keyframe, query)

    def _store(self, places: Sequence[Place]) -> None:
        rows = [
            self._unit_row(vector)
            for place in places
            for vector in (place.vector, *(other for _, other in place.keyframes))
        ]
        identifiers = np.arange(len(self._names), len(self._names) + len(rows))
        self._index.add_with_ids(np.concatenate(rows), identifiers)
        for place in places:
            first = self._id_of[place.name] = len(self._names)
            self._names += [place.name] * (1 + len(place.keyframes))
            if place.keyframes:
                self._others_of[place.name] = tuple(range(first + 1, len(self._names)))
            for identifier, (keyframe, _) in enumerate(place.keyframes, first + 1):
                self._keyframe_of[identifier] = keyframe

    def _unit_row(self, vector: ArrayLike) -> NDArray[np.float32]:
        row = np.asarray(vector, dtype=np.float32).reshape(1, -1)
        if row.shape[1] != self.dimension:
            raise InvalidInput.field(
                "vector", f"{row.shape[1]} numbers, expected {self.dimension} of this index"
            )
        norm = float(np.linalg.norm(row))
        if not np.isfinite(norm) or norm == 0.0:
            raise InvalidInput.field("vector", f"norm {norm}: expected a finite, non-zero vector")
        return np.ascontiguousarray(row / np.float32(norm))

    def _parameters(self, among: Collection[str] | None) -> Any:
        selector = None
        if among is not None:
            known = [name for name in among if name in self._id_of]
            allowed = [self._id_of[name] for name in known]
            allowed += [other for name in known for other in self._others_of.get(name, ())]
            selector = self._faiss.IDSelectorBatch(np.array(allowed, dtype=np.int64))
        if not self._is_exact:
            return self._faiss.SearchParametersIVF(nprobe=LISTS_PROBED, sel=selector)
        return self._faiss.SearchParameters(sel=selector) if selector is not None else None

    def _become_inverted_file(self) -> None:
        faiss = self._faiss
        count = self._index.ntotal
        # As they lie there: a copy of all of them may be more than there is memory.
        flat = faiss.downcast_index(self._index.index)
        vectors = faiss.rev_swig_ptr(flat.get_xb(), count * self.dimension).reshape(count, -1)
        identifiers = faiss.vector_to_array(self._index.id_map)
        lists = max(1, min(2000, count // TRAINING_VECTORS_PER_LIST))
        quantiser = faiss.IndexFlatIP(self.dimension)
        inverted = faiss.IndexIVFScalarQuantizer(
            quantiser, self.dimension, lists,
            faiss.ScalarQuantizer.QT_8bit, faiss.METRIC_INNER_PRODUCT,
        )  # fmt: skip
        # FAISS frees neither: the Python reference keeps the quantiser alive.
        inverted.referenced_objects = [quantiser]
        inverted.cp.niter = TRAINING_ROUNDS
        inverted.train(vectors[: lists * TRAINING_VECTORS_PER_LIST])
        inverted.add_with_ids(vectors, identifiers)
        self._index = inverted
        self._is_exact = False
