"""Which of the similar places are worth a registration."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

from magic_core.errors import ConfigError

SIMILARITY_THRESHOLDS = {
    # Cosine similarity, by the start of the model id; the longest match counts.
    # Measured by benchmarks/loops on red kitchen and living room, 435 pairs of anchors of which
    # 76 overlap by 30 %: recall .96 with half of all pairs left out; at .5 recall is .91.
    "efficientnet_lite0": 0.45,
    # The paper's 0.35 is a squared L2 distance of unit DINOv2 vectors: 1 - 0.35 / 2.
    "dinov2": 0.825,
}
DEFAULT_SIMILARITY_THRESHOLD = 0.5


@dataclass(frozen=True, slots=True)
class SubmapKey:
    """Which sub-map: its agent, its number within the agent, its resource name."""

    agent: str
    index: int
    name: str
    span_s: tuple[float, float] | None = None
    """Timestamps of its first and its last frame, where they are known."""


@dataclass(frozen=True, slots=True)
class LoopConfig:
    """How loop candidates are chosen from the nearest descriptors."""

    enabled: bool = True
    """Without it no candidate is chosen: every agent keeps its own odometry (an ablation)."""
    min_similarity: float | None = None
    """Least cosine similarity of the descriptors; None takes the encoder's calibrated one."""
    top_k: int = 6
    """At most this many candidates for one query."""
    top_k_per_agent: int = 4
    """At most this many with one other agent, so that a slow agent cannot take all places."""
    ask_older: int = 6
    """So many similar sub-maps that a new one has no room for are asked whether they have room for
    it: an older one may have fewer places like it. 0 for none."""
    min_index_gap: int = 2
    """Within an agent, sub-maps nearer in sequence are not loops: odometry links them already."""
    min_gap_s: float = 0.0
    """Within an agent, sub-maps with less time than this between their frames are not loops, for a
    camera that stands still or moves slowly: its many sub-maps show one place."""
    min_neighbour_gap: int = 1
    """Among the candidates of one agent, keep this distance in index (1: no two the same)."""

    def __post_init__(self) -> None:
        for name in ("top_k", "top_k_per_agent", "min_index_gap", "min_neighbour_gap"):
            if getattr(self, name) < 1:
                raise ConfigError.field(f"loops.{name}", f"{getattr(self, name)}: expected >= 1")
        if not 0.0 <= self.min_gap_s < math.inf:
            raise ConfigError.field("loops.min_gap_s", f"{self.min_gap_s}: expected >= 0 seconds")
        if self.ask_older < 0:
            raise ConfigError.field("loops.ask_older", f"{self.ask_older}: expected >= 0")
        if self.min_similarity is not None and not -1.0 <= self.min_similarity <= 1.0:
            raise ConfigError.field(
                "loops.min_similarity", f"{self.min_similarity}: expected -1 to 1"
            )

    def threshold(self, model_id: str) -> float:
        """The least similarity for descriptors of this encoder."""
        if self.min_similarity is not None:
            return self.min_similarity
        known = [prefix for prefix in SIMILARITY_THRESHOLDS if model_id.startswith(prefix)]
        if not known:
            return DEFAULT_SIMILARITY_THRESHOLD
        return SIMILARITY_THRESHOLDS[max(known, key=len)]


@dataclass(frozen=True, slots=True)
class LoopCandidate:
    """A pair of sub-maps that may show the same place."""

    query: SubmapKey
    hit: SubmapKey
    similarity: float


def select_candidates(
    query: SubmapKey,
    hits: Sequence[tuple[SubmapKey, float]],
    config: LoopConfig,
    *,
    model_id: str = "",
    is_known_pair: Callable[[str, str], bool] = lambda query, hit: False,
) -> list[LoopCandidate]:
    """The hits worth a registration, most similar first.

    Leaves out the query itself, its neighbours in the same agent by number or time, what is less
    similar than the encoder's threshold, pairs tried before, and more than a few of one agent
    (diversity).
    """
    if not config.enabled:
        return []
    threshold = config.threshold(model_id)
    chosen: list[LoopCandidate] = []
    for hit, similarity in sorted(hits, key=lambda item: (-item[1], item[0].name)):
        if len(chosen) == config.top_k or similarity < threshold:
            break
        if _is_neighbour(query, hit, config) or is_known_pair(query.name, hit.name):
            continue
        if _is_diverse(hit, chosen, config):
            chosen.append(LoopCandidate(query=query, hit=hit, similarity=similarity))
    return chosen


def left_over(
    query: SubmapKey,
    hits: Sequence[tuple[SubmapKey, float]],
    chosen: Sequence[LoopCandidate],
    config: LoopConfig,
    *,
    model_id: str = "",
    is_known_pair: Callable[[str, str], bool] = lambda query, hit: False,
) -> list[LoopCandidate]:
    """The most similar hits that `select_candidates` had no room for; those ends may have some."""
    if not config.enabled:
        return []
    taken = {candidate.hit.name for candidate in chosen}
    rest = [
        LoopCandidate(query, hit, similarity)
        for hit, similarity in sorted(hits, key=lambda item: (-item[1], item[0].name))
        if similarity >= config.threshold(model_id)
        and hit.name not in taken
        and not _is_neighbour(query, hit, config)
        and not is_known_pair(query.name, hit.name)
    ]
    return rest[: config.ask_older]


def _is_neighbour(query: SubmapKey, hit: SubmapKey, config: LoopConfig) -> bool:
    if query.agent != hit.agent:
        return False
    if abs(query.index - hit.index) < config.min_index_gap:
        return True  # itself too
    if config.min_gap_s == 0.0 or query.span_s is None or hit.span_s is None:
        return False  # a clock that was set back makes spans overlap
    gap_s = max(query.span_s[0] - hit.span_s[1], hit.span_s[0] - query.span_s[1])
    return gap_s < config.min_gap_s


def _is_diverse(hit: SubmapKey, chosen: Sequence[LoopCandidate], config: LoopConfig) -> bool:
    mates = [c.hit.index for c in chosen if c.hit.agent == hit.agent]
    apart = all(abs(index - hit.index) >= config.min_neighbour_gap for index in mates)
    return apart and len(mates) < config.top_k_per_agent
