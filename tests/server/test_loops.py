"""Loop candidates: thresholds per encoder, neighbours, diversity."""

from __future__ import annotations

import pytest

from magic_core.errors import ConfigError
from magic_server.loops import LoopConfig, SubmapKey, left_over, select_candidates


def key(agent: str, index: int, span_s: tuple[float, float] | None = None) -> SubmapKey:
    return SubmapKey(agent, index, f"{agent}/{index}", span_s)


def names(candidates) -> list[str]:
    return [candidate.hit.name for candidate in candidates]


def test_keeps_similar_places_most_similar_first():
    hits = [(key("b", 1), 0.7), (key("c", 4), 0.9), (key("b", 8), 0.3)]
    config = LoopConfig(min_similarity=0.5)
    assert names(select_candidates(key("a", 0), hits, config)) == ["c/4", "b/1"]


def test_leaves_out_itself_and_its_neighbours_in_the_same_agent_only():
    hits = [(key("a", 5), 1.0), (key("a", 4), 0.95), (key("a", 3), 0.9), (key("b", 5), 0.8)]
    config = LoopConfig(min_similarity=0.5, min_index_gap=2)
    assert names(select_candidates(key("a", 5), hits, config)) == ["a/3", "b/5"]


def test_leaves_out_what_the_same_agent_saw_a_moment_ago_in_either_direction():
    hits = [
        (key("a", 0, (0.0, 9.0)), 0.99),
        (key("a", 2, (20.0, 28.5)), 0.98),
        (key("a", 8, (51.0, 60.0)), 0.97),
        (key("a", 9, (70.0, 80.0)), 0.96),
        (key("b", 2, (20.0, 28.5)), 0.95),
    ]
    config = LoopConfig(min_similarity=0.5, min_gap_s=12.0, top_k_per_agent=9)
    query = key("a", 5, (40.0, 50.0))
    assert names(select_candidates(query, hits, config)) == ["a/0", "a/9", "b/2"]
    assert names(left_over(query, hits, [], config)) == ["a/0", "a/9", "b/2"]
    again = [(key("a", 0, (40.0, 50.0)), 0.9)]
    assert names(select_candidates(query, again, LoopConfig(min_similarity=0.5))) == ["a/0"]


@pytest.mark.parametrize("seconds", [-1.0, float("nan"), float("inf")])
def test_the_time_between_loops_is_a_time(seconds: float):
    with pytest.raises(ConfigError, match=r"loops\.min_gap_s"):
        LoopConfig(min_gap_s=seconds)


def test_one_agent_cannot_take_all_places():
    hits = [(key("b", i), 0.9 - 0.01 * i) for i in range(6)] + [(key("c", 0), 0.6)]
    config = LoopConfig(min_similarity=0.5, top_k=4, top_k_per_agent=2)
    assert names(select_candidates(key("a", 0), hits, config)) == ["b/0", "b/1", "c/0"]


def test_candidates_of_one_agent_keep_their_distance():
    hits = [(key("b", i), 0.9 - 0.01 * i) for i in range(6)]
    config = LoopConfig(min_similarity=0.5, top_k=9, top_k_per_agent=9, min_neighbour_gap=3)
    assert names(select_candidates(key("a", 0), hits, config)) == ["b/0", "b/3"]


def test_pairs_tried_before_are_left_out():
    hits = [(key("b", 0), 0.9), (key("b", 1), 0.8)]
    chosen = select_candidates(
        key("a", 0),
        hits,
        LoopConfig(min_similarity=0.5),
        is_known_pair=lambda query, hit: hit == "b/0",
    )
    assert names(chosen) == ["b/1"]


def test_hits_without_room_are_left_for_the_other_end_to_choose():
    hits = [(key("b", i), 0.9 - 0.01 * i) for i in range(5)] + [
        (key("a", 1), 0.89), (key("c", 0), 0.4)
    ]  # fmt: skip
    config = LoopConfig(min_similarity=0.5, top_k_per_agent=2, ask_older=2)
    chosen = select_candidates(key("a", 0), hits, config)
    assert names(chosen) == ["b/0", "b/1"]
    rest = left_over(
        key("a", 0), hits, chosen, config, is_known_pair=lambda query, hit: hit == "b/2"
    )
    assert names(rest) == ["b/3", "b/4"]
    assert not left_over(key("a", 0), hits, chosen, LoopConfig(ask_older=0, min_similarity=0.5))


def test_threshold_follows_the_encoder():
    config = LoopConfig()
    assert config.threshold("dinov2_vits14-0123") == pytest.approx(0.825)  # the paper's 0.35
    assert config.threshold("efficientnet_lite0-gap1280-v1") < config.threshold("dinov2_x")
    assert LoopConfig(min_similarity=0.1).threshold("dinov2_x") == 0.1


def test_refuses_impossible_settings():
    with pytest.raises(ConfigError):
        LoopConfig(top_k=0)
    with pytest.raises(ConfigError):
        LoopConfig(min_similarity=1.5)
