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

EXACT_LIMIT = 100_000
TRAINING_VECTORS_PER_LIST = 50
LISTS_PROBED = 32
LOADED_AT_ONCE = 10_000
BLAS_THRESHOLD = 3072
"""FAISS skips BLAS for small batches of long vectors, which is 18 times slower at 384 numbers."""


class DescriptorIndex:
    """Unit vectors of one encoder under their names. Not thread-safe: one owner."""

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
        self._id_of: dict[str, int] = {}
        self._name_of: dict[int, str] = {}
        self._next_id = 0

    def __len__(self) -> int:
        return len(self._id_of)

    def __contains__(self, name: str) -> bool:
        return name in self._id_of

    @property
    def is_exact(self) -> bool:
        """Whether every query compares with every vector."""
        return self._is_exact

    def add(self, name: str, vector: ArrayLike) -> None:
        """Store a vector (dimension,); it is normalised. Raises AlreadyExists for a known name."""
        if name in self._id_of:
            raise AlreadyExists(f"descriptor {name!r} is in the index already; remove it first")
        row = self._unit_row(vector)
        identifier, self._next_id = self._next_id, self._next_id + 1
        self._index.add_with_ids(row, np.array([identifier], dtype=np.int64))
        self._id_of[name] = identifier
        self._name_of[identifier] = name
        if self._is_exact and len(self) > self._exact_limit:
            self._become_inverted_file()

    def load(self, names: Sequence[str], vectors: Sequence[ArrayLike]) -> None:
        """Store many (dimension,) at once: one by one, a million take an inverted file minutes.

        Raises AlreadyExists for a known name, before anything is stored.
        """
        known = set(names)
        if len(known) < len(names) or not known.isdisjoint(self._id_of):
            raise AlreadyExists("descriptors under one name twice, or in the index already")
        for first in range(0, len(names), LOADED_AT_ONCE):
            chunk = names[first : first + LOADED_AT_ONCE]
            rows = [self._unit_row(v) for v in vectors[first : first + LOADED_AT_ONCE]]
            identifiers = np.arange(self._next_id, self._next_id + len(chunk))
            self._index.add_with_ids(np.concatenate(rows), identifiers)
            self._next_id += len(chunk)
            self._id_of.update(zip(chunk, identifiers.tolist(), strict=True))
            self._name_of.update(zip(identifiers.tolist(), chunk, strict=True))
            if self._is_exact and len(self) > self._exact_limit:
                self._become_inverted_file()

    def remove(self, name: str) -> None:
        """Forget a vector. Raises NotFound for an unknown name."""
        if name not in self._id_of:
            raise NotFound(f"descriptor {name!r} is not in the index")
        identifier = self._id_of.pop(name)
        del self._name_of[identifier]
        self._index.remove_ids(np.array([identifier], dtype=np.int64))

    def query(
        self, vector: ArrayLike, k: int, *, among: Collection[str] | None = None
    ) -> list[tuple[str, float]]:
        """The k nearest names with their cosine similarity, best first, ties by age.

        `among` keeps the search to some names (of one session, say); unknown ones are ignored.
        """
        if k < 1 or not self._id_of:
            return []
        parameters = self._parameters(among)
        wanted = min(k, len(self))
        similarities, identifiers = self._index.search(
            self._unit_row(vector), wanted, params=parameters
        )
        found = [
            (int(identifier), float(similarity))
            for identifier, similarity in zip(identifiers[0], similarities[0], strict=True)
            if identifier >= 0
        ]
        found.sort(key=lambda hit: (-hit[1], hit[0]))
        return [(self._name_of[identifier], similarity) for identifier, similarity in found]

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
            allowed = [self._id_of[name] for name in among if name in self._id_of]
            selector = self._faiss.IDSelectorBatch(np.array(allowed, dtype=np.int64))
        if not self._is_exact:
            return self._faiss.SearchParametersIVF(nprobe=LISTS_PROBED, sel=selector)
        return self._faiss.SearchParameters(sel=selector) if selector is not None else None

    def _become_inverted_file(self) -> None:
        faiss = self._faiss
        count = self._index.ntotal
        vectors = self._index.index.reconstruct_n(0, count)
        identifiers = faiss.vector_to_array(self._index.id_map)
        lists = max(1, min(2000, count // TRAINING_VECTORS_PER_LIST))
        quantiser = faiss.IndexFlatIP(self.dimension)
        inverted = faiss.IndexIVFScalarQuantizer(
            quantiser, self.dimension, lists,
            faiss.ScalarQuantizer.QT_8bit, faiss.METRIC_INNER_PRODUCT,
        )  # fmt: skip
        # FAISS frees neither: the Python reference keeps the quantiser alive.
        inverted.referenced_objects = [quantiser]
        sample = np.random.default_rng(0).permutation(count)[: lists * TRAINING_VECTORS_PER_LIST]
        inverted.train(np.ascontiguousarray(vectors[np.sort(sample)]))
        inverted.add_with_ids(vectors, identifiers)
        self._index = inverted
        self._is_exact = False
